"""Environments as the worker plays them: one interface, an adapter for Gymnasium, and toys without a simulator."""

from __future__ import annotations

from evopolicy_worker.environments.interface.actions import compile_actions as compile_actions
from evopolicy_worker.environments.interface.base import Environment as Environment
from evopolicy_worker.environments.interface.base import Frame as Frame
from evopolicy_worker.environments.interface.base import Step as Step
from evopolicy_worker.environments.interface.settings import process_environment as process_environment
from evopolicy_worker.environments.registry import check_played as check_played
from evopolicy_worker.environments.registry import define as define
from evopolicy_worker.environments.registry import defined as defined
from evopolicy_worker.environments.registry import definition as definition
from evopolicy_worker.environments.registry import describe as describe
from evopolicy_worker.environments.registry import make as make
from evopolicy_worker.environments.registry import measured as measured
from evopolicy_worker.environments.registry import missing as missing
from evopolicy_worker.environments.registry import offered as offered
