"""Shipped laws for tests that run many of them, from the registry."""

from ffsm_drake.systems.registry import find_factory, shipped_names

PROGRAMS = ("mpc", "nmpc")  # they solve programs, which is not traced


def traced_laws(*without: str) -> tuple[str, ...]:
    """Names of the laws that can be traced, of joints and of frames."""
    return tuple(name for name in shipped_names("controller") if name not in (*PROGRAMS, *without))


def frame_laws() -> tuple[str, ...]:
    """Names of the laws that track a frame."""
    return tuple(
        name
        for name in shipped_names("controller")
        if getattr(find_factory("controller", name), "tracks_frame", False)
    )


def joint_laws(*without: str) -> tuple[str, ...]:
    """Names of the traced laws that track coordinates."""
    return traced_laws(*frame_laws(), *without)
