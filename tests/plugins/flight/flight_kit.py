"""Exported laws with their kits, and programs of the kits."""

import functools
import shutil

import pytest
from children import finished

from ffsm_drake import load_scenario
from ffsm_drake.plugins.flight.export import write_c

MINUTES = 300.0  # s that a program of a kit may take


def exported(folder, scenario, *settings, **options):
    """A law with its kit in a folder. Args: as of ``load_scenario``; ``write_c``."""
    write_c(load_scenario(scenario, list(settings)), folder / "law.c", kit=True, **options)
    return folder


@functools.cache
def need(*programs):
    """Skip the test if a program is missing."""
    for each in programs:
        if shutil.which(each) is None:
            pytest.skip(f"{each} is not installed")


def make(folder, *arguments, code=0):
    """What make prints in a kit's folder."""
    need("make")
    done = finished(["make", "-C", str(folder), *arguments], longest=MINUTES)
    text = done.stdout + done.stderr
    assert done.returncode == code, text[-3000:]
    return text


def run(folder, *command, code=0):
    """What a command prints in a kit's folder."""
    done = finished([*map(str, command)], cwd=folder, longest=MINUTES)
    text = done.stdout + done.stderr
    assert done.returncode == code, text[-3000:]
    return text
