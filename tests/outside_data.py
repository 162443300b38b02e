"""Files of public repositories that are not kept in this one: read at one commit, or skipped.

``OUTSIDE_DATA`` names a folder with clones. ``docs/validation/outside_data.md`` has the commands.
"""

import os
from pathlib import Path

import pytest
from children import finished

FOLDER = os.environ.get("OUTSIDE_DATA", "")


def outside_file(repository, commit, path):
    """The text of a file of OWNER/NAME at a commit; the test is skipped where there is no clone."""
    clone = Path(FOLDER) / repository.partition("/")[2]
    if not FOLDER or not clone.exists():
        pytest.skip(
            f"needs data that is not shipped: git clone https://github.com/{repository} "
            f"DIR/{clone.name}, and set OUTSIDE_DATA=DIR"
        )
    return finished(
        ["git", "-C", str(clone), "show", f"{commit}:{path}"], check=True, longest=60
    ).stdout
