import sys

from evopolicy_gateway.agents.evolve.agent import main

sys.exit(main())
