from evopolicy_gateway.agents.evolve.agent import main

main()
