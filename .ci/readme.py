"""The README as a package index shows it: links within the repository become addresses, those of
``Repository`` in pyproject.toml at the tag of the version.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[([^]]*)\]\((?![a-z]+:|#)([^)]+)\)")


class AbsoluteLinks(MetadataHookInterface):
    """Sets ``readme``, which pyproject.toml therefore names as dynamic."""

    def update(self, metadata: dict[str, Any]) -> None:
        address, tag = metadata["urls"]["Repository"], f"v{metadata['version']}"

        def absolute(match: re.Match[str]) -> str:
            kind = "raw" if match[1] else "blob"
            return f"{match[1]}[{match[2]}]({address}/{kind}/{tag}/{match[3]})"

        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        content = {"content-type": "text/markdown", "text": _LINK.sub(absolute, text)}
        metadata["readme"] = content
