"""Puts three.js into the wheel; an editable install leaves that to `dev.py setup`."""

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PageHook(BuildHookInterface):
    """Builds three.js before the wheel is packed."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build three.js where it is missing, and add it to the wheel although git ignores it."""
        if version == "editable":
            return
        here = Path(self.root) / "web" / "build.py"
        spec = importlib.util.spec_from_file_location("echelon_page", here)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.build()
        built = [module.BUNDLE, module.LICENSE]
        build_data["artifacts"] += [path.relative_to(self.root).as_posix() for path in built]
