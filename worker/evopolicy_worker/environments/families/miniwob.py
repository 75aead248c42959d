"""MiniWoB++: small tasks in web pages, played in Chromium."""

from __future__ import annotations

import pkgutil
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.browser import chromium, miniwob_pages
from evopolicy_worker.environments.browser.page import shared
from evopolicy_worker.environments.interface.actions import ActionCodec
from evopolicy_worker.environments.interface.fingerprint import versions
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily

if TYPE_CHECKING:
    import gymnasium


class MiniWoBFamily(GymnasiumFamily):
    distributions = ("miniwob",)
    modules = ("gymnasium", "miniwob")
    extra = "browser"
    sources = ("environments/browser/*",)
    remembers = True
    measures = True
    prefix, suffix = "miniwob/", "-v1"
    environment = "miniwob_env:MiniWoBEnv"
    """Module and class of its environments."""

    def installed(self) -> bool:
        return super().installed() and not chromium.lacking()

    def needs(self) -> str:
        packages = "" if super().installed() else super().needs()
        return "; ".join(filter(None, (packages, chromium.lacking())))

    def load(self) -> None:
        """Imports Gymnasium alone: the package's own classes would import Selenium, and are not used."""
        import gymnasium  # noqa: F401

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        """The page that the id names."""
        kind = pkgutil.resolve_name(f"{chromium.__package__}.{self.environment}")
        mode = "rgb_array" if render else None
        made: gymnasium.Env[Any, Any] = kind(self._page(entry), **entry.kwargs, render_mode=mode)
        return made

    def task_sections(self, entry: Entry, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
        """The package's documentation of the page, without a reward's formula, and examples of its instructions."""
        page = miniwob_pages.texts().get(self._page(entry), miniwob_pages.PageText())
        examples = "\n".join(f"* {each}" for each in page.examples)
        parts = [
            page.description,
            "" if "%" in page.notes else page.notes,
            f"The page's instruction is such as:\n\n{examples}" if examples else "",
        ]
        text = "\n\n".join(filter(None, parts))
        return {"": re.sub(r" +", " ", re.sub(r"^ +", "", text, flags=re.MULTILINE))}

    def _page(self, entry: Entry) -> str:
        return str(entry.gymnasium_id).removeprefix(self.prefix).removesuffix(self.suffix)

    def draw(self, codec: ActionCodec, rng: np.random.Generator, obs: Any) -> Any:
        from evopolicy_worker.environments.browser import draws

        return codec.repair(draws.miniwob(obs, codec.sample(rng), rng))[0]

    def packages(self, entry: Entry) -> dict[str, str]:
        """Also the browser, and what its fonts measure: both decide where elements are."""
        return versions(("numpy", *self.distributions)) | shared().identity()

    def version(self, entry: Entry) -> str:
        """As others, with the browser."""
        return f"{super().version(entry)[:-1]}, Chromium {shared().identity()['chromium']})"


FAMILY = MiniWoBFamily()
