"""Opaque objects: spaces of a kind that the protocol has no form for, whose values their family encodes itself.

A family names, for such a space, a space of a known kind, and how a value becomes one of that space and back
(`GymnasiumFamily.opaque`). Policies, feedback and recordings have the encoded values only. The space may be a part of a
Dict or Tuple.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import gymnasium

Convert = Callable[[Any], Any]


class Opaque(NamedTuple):
    """How a family encodes the values of one space."""

    space: gymnasium.Space[Any]
    """Of a known kind; what policies see."""
    encode: Convert
    """From a value of the opaque space to one of `space`."""
    decode: Convert
    """Back, for actions; gets repaired values."""


Hook = Callable[["gymnasium.Space[Any]"], Opaque | None]


def declared(space: gymnasium.Space[Any]) -> Opaque | None:
    """The encoding that a space declares itself by `encoded_space`, `encode` and `decode`; None without these."""
    parts: list[Any] = [getattr(space, name, None) for name in ("encoded_space", "encode", "decode")]
    return None if any(part is None for part in parts) else Opaque(*parts)


def visible(space: gymnasium.Space[Any], hook: Hook) -> gymnasium.Space[Any]:
    """The space with known kinds in place of opaque ones."""
    from gymnasium import spaces

    opaque = hook(space)
    if opaque is not None:
        return opaque.space
    if isinstance(space, spaces.Dict):
        # As pairs: of a dict, Gymnasium sorts the keys.
        return spaces.Dict([(key, visible(part, hook)) for key, part in space.spaces.items()])
    if isinstance(space, spaces.Tuple):
        return spaces.Tuple([visible(part, hook) for part in space.spaces])
    return space


def converter(space: gymnasium.Space[Any], hook: Hook, *, back: bool) -> Convert | None:
    """Encodes values of a space, or decodes them (`back`); None where nothing in it is opaque."""
    from gymnasium import spaces

    opaque = hook(space)
    if opaque is not None:
        return opaque.decode if back else opaque.encode
    if isinstance(space, spaces.Dict):
        named = {
            key: made for key, part in space.spaces.items() if (made := converter(part, hook, back=back))
        }
        if named:
            return lambda value: {**value, **{key: made(value[key]) for key, made in named.items()}}
    if isinstance(space, spaces.Tuple):
        parts = [converter(part, hook, back=back) for part in space.spaces]
        if any(parts):
            return lambda value: tuple(
                each if made is None else made(each) for made, each in zip(parts, value, strict=True)
            )
    return None
