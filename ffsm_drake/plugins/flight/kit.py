"""The kit of an exported law: files that prove it and fly it, and a recorded run for its replay."""

import re
from collections.abc import Iterator
from pathlib import Path

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.files import write_text

REPLAY = "replay.txt"
_FOLDER = Path(__file__).parent / "c" / "kit"


def write_kit(folder: Path, stem: str, replay_text: str, *, tolerance: float = 0.0) -> list[Path]:
    """Write the kit of a law into a folder. ``replay.txt`` is written anew; other files that are
    there stay.

    Args:
      folder: of the law's source file and header.
      stem: their name without .c and .h.
      replay_text: ``Recorded.text`` of a run of the law.
      tolerance: of the replay, as a share of the largest force; 0: bit for bit.

    Returns: the paths of the kit's files.

    Raises:
      FfsmError: a file of the kit would be the law's or replace another one, and nothing has been
        written; or the place cannot be written.
    """
    made = {folder / name: text for name, text in _texts(stem)}
    for path, text in made.items():
        if path.exists() and (not path.is_file() or path.read_bytes() != text.encode()):
            raise FfsmError(f"{path} is there and differs from the kit's; move it, or export to "
                            "another folder")  # fmt: skip
    for path, text in made.items():
        write_text(path, text)
    write_text(folder / REPLAY, f"# tolerance {tolerance:g}\n{replay_text}")
    return [*made, folder / REPLAY]


def _texts(stem: str) -> Iterator[tuple[str, str]]:
    """The files by name. They include ``law.h``, and the Makefile has it as LAW."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.+-]*", stem):
        problem = "a kit needs a name of letters, digits and _ . + -, for its Makefile"
        raise FfsmError(f"{stem}.c: {problem}")
    for path in sorted(_FOLDER.rglob("*")):
        if path.is_dir():
            continue
        if path.suffix in (".c", ".h") and path.stem == stem:
            raise FfsmError(f"{stem}.c: a file of the kit has this name; give another")
        text = path.read_text(encoding="utf-8")
        for own, law in (('"law.h"', f'"{stem}.h"'), ("\nLAW = law\n", f"\nLAW = {stem}\n")):
            text = text.replace(own, law)
        yield str(path.relative_to(_FOLDER)), text
