# ruff: noqa: RUF001 (the texts use mathematical signs)
"""What the paper prints: Table 2, with two slips that its own numbers give away; and what its
adverbs are taken for.
"""

from ffsm_drake.studies.paper.runs import CONTROLLERS

CITATION = (
    "Zhang et al., TDE-Based Adaptive Integral Sliding Mode Control of Space Manipulator for "
    "Space-Debris Active "
    "Removal, Aerospace 9 (2022) 105, doi:10.3390/aerospace9020105"
)


def _row(*values: float) -> dict[str, float]:
    return dict(zip(CONTROLLERS, values, strict=True))


# Disturbance -> controller -> value, corrected.
ITAE = {
    "tau_d1": _row(1.041e-3, 1.913e-3, 4.725e-3, 6.264e-3),
    "tau_d2": _row(1.041e-3, 1.912e-3, 4.726e-3, 6.263e-3),
    "tau_d3": _row(1.041e-3, 1.914e-3, 4.726e-3, 6.264e-3),
}
ISV = {
    "tau_d1": _row(393.9, 387.2, 377.6, 377.2),
    "tau_d2": _row(368.2, 361.3, 351.7, 351.3),
    "tau_d3": _row(489.1, 482.4, 472.8, 472.4),
}

# (metric, disturbance, controller) -> what is printed there, and why it is read otherwise.
CORRECTIONS = {
    (
        "itae",
        "tau_d3",
        "aismc",
    ): "printed as 1.914×10⁻⁴, which would beat the proposed controller's starred 1.041×10⁻³; "
    "read as 1.914×10⁻³, like its neighbours",
    ("isv", "tau_d3", "tdc"): "printed without the star of the best value, although it is the "
    "smallest of its row",
}

# What the paper's adverbs are taken to mean.
NEARLY_TENFOLD = 5.0  # "nearly one order of magnitude": at least this factor
SLIGHTLY = 0.05  # "slightly larger": by at most this share
NOTICEABLE = 0.02  # an effect below this share is none
REPRODUCED = 0.03  # a table's values are reproduced within this share
LOCALLY = 0.5  # "only locally": in less than this share of time and coordinates
PRECISELY = 1e-5  # "high precision": errors at the end below this, rad and m
ACCURATELY = 0.1  # "accurately estimated": within this share
