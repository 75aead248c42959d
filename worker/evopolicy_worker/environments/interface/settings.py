"""The process environment in which simulators run: threads, drivers, hash seed, locale, time zone.

A simulator may read these variables only while it is imported, so a slot process is *started* with them. `apply` sets
missing variables in a process that was started otherwise (tests, `evopolicy try`).
"""

from __future__ import annotations

import os

_ALWAYS = {
    # One slot has one core; and the order of summation in a threaded BLAS depends on the number of threads.
    **{f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")},
    # "dummy" makes the frames of highway-env black; "offscreen" draws, and needs no display either.
    "SDL_VIDEODRIVER": "offscreen",
    "SDL_AUDIODRIVER": "dummy",
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "PYGLET_HEADLESS": "1",
    # With its hidden window a process that forks afterwards hangs.
    "PYGLET_SHADOW_WINDOW": "0",
    "MPLBACKEND": "Agg",
    "PYTHONHASHSEED": "0",
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
}
_ONLY_AT_START = {"PYTHONHASHSEED", "LC_ALL", "TZ"}
"""Read once by a starting interpreter or C library: setting them later would only confuse children."""


BROWSER = "EVOPOLICY_BROWSER"
"""Names the program that plays environments that are web pages, where it is not the machine's own Chromium."""
_ACCELERATIONS = "EVOPOLICY_ACCELERATIONS"
"""`off` makes every environment play as its library does it; anything else, or nothing, leaves accelerations on."""


def process_environment(*, render: bool = False) -> dict[str, str]:
    """Variables that a slot process is started with; accelerations are as in this process. `render=True` also selects
    MuJoCo's off-screen renderer."""
    variables = {**_ALWAYS, _ACCELERATIONS: "on" if accelerations_on() else "off"}
    if render:
        # Without it the second MuJoCo environment that draws aborts the process.
        variables["MUJOCO_GL"] = "egl"
        variables["PYOPENGL_PLATFORM"] = "egl"
    return variables


def accelerations_on() -> bool:
    """Whether this process's environment has accelerations on, which is the default."""
    return os.environ.get(_ACCELERATIONS, "on").strip().lower() not in ("off", "0", "false", "no")


def apply(*, render: bool = False) -> None:
    """Sets unset variables in this process, for simulators that are imported after this call."""
    for name, value in process_environment(render=render).items():
        if name not in _ONLY_AT_START:
            os.environ.setdefault(name, value)
