"""Settings of the true geometry of the arm: ``effects.geometry``."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting


@dataclass
class Thermal:
    """Thermal expansion of the links along the orbit."""

    expansion: float = setting(
        2.3e-5, "1/K", "coefficient of linear expansion of the links; default: aluminium", least=0
    )
    mean: float = setting(
        0.0, "K", "mean over the orbit of the temperature above that of the nominal model"
    )
    amplitude: float = setting(50.0, "K", "amplitude of the temperature over the orbit", least=0)
    period: float = setting(5560.0, "s", "period of the temperature, that of the orbit", above=0)
    time: float = setting(
        0.0,
        "s",
        "time of the run on the orbit; the temperature is mean + amplitude sin(2 pi time / period)",
    )


@dataclass
class Geometry:
    """Errors of the true geometry of the arm; the controller's model has none of them.

    The link of a joint is the one before it, from the joint before, or from the base's origin.
    """

    stretch: dict[str, float] = setting(
        {"all": 0.0}, "", "relative elongation of the link of each joint", above=-1, below=1
    )
    hand_stretch: float = setting(
        0.0, "", "relative elongation of the last link, up to ``model.end_effector``",
        above=-1, below=1,
    )  # fmt: skip
    joint_offset: dict[str, float] = setting(
        {"all": 0.0}, "rad or m", "true position of a joint minus its measured one"
    )
    mount_position: list[float] = setting(
        [0.0, 0.0, 0.0], "m", "error of the position of the arm's first joint, base axes",
        size=(3, 3),
    )  # fmt: skip
    mount_rotation: list[float] = setting(
        [0.0, 0.0, 0.0],
        "rad",
        "rotation vector of the error of the arm's attitude on the base, base axes",
        size=(3, 3),
    )
    stretch_deviation: float = setting(
        0.0, "", "standard deviation of a normal error that is drawn and added to each elongation",
        least=0, most=0.1,
    )  # fmt: skip
    offset_deviation: float = setting(
        0.0, "rad or m", "the same for each joint's offset", least=0, most=1
    )
    mount_position_deviation: float = setting(
        0.0, "m", "the same for each component of ``mount_position``", least=0, most=1
    )
    mount_rotation_deviation: float = setting(
        0.0, "rad", "the same for each component of ``mount_rotation``", least=0, most=1
    )
    seed: int | None = setting(
        None, "", "seed of the draws; null: ``random_seed``", least=0, most=2**31 - 1
    )
    thermal: Thermal | None = setting(
        None, "", "thermal expansion, constant in a run, which adds to every elongation; null: none"
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that one hand holds the target: a displaced chain of two arms does not close."""
        if len(scenario.contacts) > 1:
            yield key, "needs a single hand; remove contacts"
