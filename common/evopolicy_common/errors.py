"""Errors, grouped by whose fault they are.

A message says what was wrong, with the value, and what to do about it. `RequestError` may be shown to an agent;
the others are for operators and never cross the visibility boundary.
"""

from __future__ import annotations

import msgspec

from evopolicy_common.wire.refusals import Refusal

DECODE_ERRORS = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What msgspec raises for bytes that are not what was expected: malformed or of another shape, text that is not UTF-8
inside, or nested without end."""


class EvopolicyError(Exception):
    """Base of every error this project raises on purpose."""


class RequestError(EvopolicyError):
    """The agent's or operator's request cannot be served as it is; nothing was changed by it."""

    def __init__(self, status: str, message: str) -> None:
        super().__init__(message)
        self.status = status
        self.message = message


class ConfigError(EvopolicyError):
    """A setting, file or command-line value is wrong; the message names it and the remedy."""


class MachineError(ConfigError):
    """The machine refuses what is needed, as a full or read-only disk does, and may give it later.

    Exit code 1, not 2: whoever keeps the program up starts it again.
    """


class BundleError(EvopolicyError):
    """A policy folder cannot be snapshot, or stored bytes are not the bundle their digest names."""


class ProtocolError(EvopolicyError):
    """A peer sent bytes that are not a message of this protocol version."""


class TransportError(EvopolicyError):
    """The other side could not be reached, or did not answer in time; asking again is safe."""


class RefusedError(EvopolicyError):
    """The coordinator answered, and refused: a wrong token, an unknown run, a closed run."""

    def __init__(self, status: Refusal, message: str) -> None:
        super().__init__(f"{message} ({status})")
        self.status = status
        self.message = message


class SandboxError(EvopolicyError):
    """The sandbox itself failed (not the policy in it): infrastructure, retried and never charged."""


class WorkerError(EvopolicyError):
    """A worker, or one of its slots, was lost or cannot do what it was asked: infrastructure, never charged."""


class SlotDiedError(WorkerError):
    """A slot's processes were ended from outside while its supervisor lives."""


class PartFailedError(EvopolicyError):
    """A part of a process met what it does not know how to go on from: the process ends with this, to be started again."""


class StorageError(EvopolicyError):
    """The store could not persist or read back; what was not persisted did not happen."""


class DamagedStoreError(StorageError):
    """What is stored cannot be read, or contradicts itself: trying again does not help."""
