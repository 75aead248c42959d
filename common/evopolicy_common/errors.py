"""Errors, grouped by cause.

A message states the problem, the value, and the remedy. `RequestError` may be shown to an agent; the others are for
operators and never reach an agent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from evopolicy_common.refusals import Refusal

if TYPE_CHECKING:
    import msgspec

    DECODE_ERRORS: tuple[type[msgspec.DecodeError], type[UnicodeDecodeError], type[RecursionError]]
    """Errors of msgspec for input that is malformed, of another shape, not UTF-8, or nested without end."""


def __getattr__(name: str) -> Any:
    """`DECODE_ERRORS`, on first use: a command's help imports this module, and needs no msgspec."""
    if name != "DECODE_ERRORS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import msgspec

    kinds = globals()[name] = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
    return kinds


class EvopolicyError(Exception):
    """Base class of every error that this project raises on purpose."""


class RequestError(EvopolicyError):
    """The agent's or operator's request cannot be served as it is; it changed nothing."""

    def __init__(self, status: str, message: str) -> None:
        super().__init__(message)
        self.status = status
        self.message = message


class ConfigError(EvopolicyError):
    """A setting, file or command-line value is wrong; the message names it and the remedy."""


class MachineError(ConfigError):
    """The machine refuses a resource that it may provide later. Exit code 1: a process manager restarts."""


class BundleError(EvopolicyError):
    """A snapshot of a policy folder cannot be made, or stored bytes do not match the bundle's digest."""


class ProtocolError(EvopolicyError):
    """A peer sent bytes that are not a message of this protocol version."""


class TransportError(EvopolicyError):
    """The other side could not be reached, or did not reply in time; the request may be sent again."""


class RefusedError(EvopolicyError):
    """The coordinator refused the request: a wrong token, an unknown run, a closed run."""

    def __init__(self, status: Refusal, message: str) -> None:
        super().__init__(f"{message} ({status})")
        self.status = status
        self.message = message


class SandboxError(EvopolicyError):
    """The sandbox itself failed, not the policy in it. This is an infrastructure failure: retried and never charged."""


class WorkerError(EvopolicyError):
    """A worker or one of its slots was lost, or cannot do its job. This is an infrastructure failure, never charged."""


class BrokenEnvironmentError(WorkerError):
    """An environment raises, hangs, or leaves its spaces. Neither the policy nor the worker is to blame."""


class SlotDiedError(WorkerError):
    """A slot's processes were ended from outside while its supervisor is alive."""


class PartFailedError(EvopolicyError):
    """A part of a process met an error that it cannot handle; the process ends with it, to be restarted."""


class StorageError(EvopolicyError):
    """The store could not persist or read data; nothing unpersisted takes effect."""


class LeadLostError(StorageError):
    """Another coordinator writes this store, or may: this one must answer nothing until it leads again."""


class DamagedStoreError(StorageError):
    """Stored data cannot be read or contradict each other; a retry does not help."""


@contextlib.contextmanager
def raised_as(
    kind: Callable[[str], Exception], problem: object, *causes: type[Exception], remedy: str = ""
) -> Iterator[None]:
    """Raises errors of `causes` in its body as a `kind` with the problem, the reason and the remedy as text."""
    try:
        yield
    except causes as error:
        reason = getattr(error, "strerror", None) or error
        raise kind(f"{problem}: {reason}" + (f"; {remedy}" if remedy else "")) from error
