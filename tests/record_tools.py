"""Records whose contents tests change."""

import json
from pathlib import Path

from ffsm_drake.runs.reading import IDENTIFIER, SEAL, digest_of, seal_of


def sealed(folder: Path) -> None:
    """Make the checksums of a record fit its files again."""
    identifier = digest_of(folder / "record.nc")
    for name in ("metrics.json", "manifest.json"):
        path = folder / name
        try:
            data = json.loads(path.read_bytes())
            data[IDENTIFIER] = identifier
            if name == "manifest.json":
                data[SEAL] = seal_of(data)
            path.write_text(json.dumps(data))
        except (ValueError, TypeError, OSError):
            pass  # it holds no object any more
