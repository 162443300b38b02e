"""Scenarios with every traceable law on three spacecraft, drawn at random."""

import random
from pathlib import Path

from law_lists import frame_laws, traced_laws

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.spacecraft.plant import configuration

EXAMPLE = Path(__file__).parents[3] / "examples" / "courier.urdf"
LATER = ("fixed_time_observer", "prescribed_performance")  # after others, so that draws stay
LAST = ("adaptive_zero_reaction",)
TRACEABLE = [*sorted(traced_laws(*LATER, *LAST)), *LATER, *LAST]
OF_FRAMES = frame_laws()
TIME_DELAY = (
    "aismc", "asmc", "fixed_time", "prescribed_performance", "super_twisting", "task_time_delay",
    "tdc", "tde_aismc", "terminal_sliding_mode",
)  # fmt: skip
CRAFT = ("postcapture", "seven_joint", "courier")  # 5, 7 and 4 joints, the last one a user's


def users_scenario(folder: Path) -> str:
    """The scenario of a spacecraft of a user."""
    urdf = folder / "courier.urdf"
    urdf.write_text(EXAMPLE.read_text())
    return str(new_scenario(urdf, folder / "courier").scenario_file)


def drawn(seed: int, courier: str, *, gently: bool = False):
    """A scenario: the law and the spacecraft in turn, all else at random; ``gently`` without what
    can make its run diverge.
    """
    draw = random.Random(seed)
    others = TRACEABLE[: -len((*LATER, *LAST))]
    cases = [(law, craft) for laws in (others, LATER, LAST) for craft in CRAFT for law in laws]
    law, craft = cases[seed % len(cases)]
    base = {"courier": courier}.get(craft, craft)
    duration = draw.choice([2.0, 4.0, 6.0])
    duration = 15.0 if gently else duration
    given = [
        f"controller={law}", f"random_seed={seed}", f"duration={duration + 1.0}",
        f"reference.duration={duration}", f"reference.kind={draw.choice(['quintic', 'septic'])}",
        f"reference.base_rotation={draw.choice(['eigenaxis', 'rpy'])}",
        f"sensing.velocity_noise.all={10.0 ** draw.uniform(-8, -5)}",
        f"sensing.position_noise.all={draw.choice([0.0, 1e-6])}",
    ]  # fmt: skip
    # the whole motion would be too fast for limits
    near = load_scenario(base).initial_posture.joints
    given += [f"target_posture.joints.{name}={value + 0.1}" for name, value in near.items()]
    hard = list[str]()
    if draw.random() < 0.5:
        hard += [f"actuation.limit.all={draw.uniform(5.0, 50.0)}"]
    if draw.random() < 0.3:
        hard += [f"actuation.quantization.all={draw.choice([0.01, 0.001])}"]
    if draw.random() < 0.2:
        hard += ["actuation.delay=1"]
    if draw.random() < 0.4:
        hard += [f"command_filter.low_pass.joints={draw.uniform(20.0, 40.0)}"]
    if draw.random() < 0.3:
        hard += [f"command_filter.notch.joints={draw.uniform(10.0, 40.0)}"]
    if gently:
        hard = ["actuation.limit.all=200"]
        given += ["sensing.velocity_noise.all=1e-7", "sensing.position_noise.all=0"]
    if law in TIME_DELAY:
        kind = draw.choice(["one_sample", "kalman", "coupled", "late kalman", "late coupled"])
        kind = "kalman" if gently and "late" in kind else kind
        given += [f"estimator.kind={kind.removeprefix('late ')}"]
        if "late" in kind:
            given += ["sensing.position_period.base_position=5"]
            given += ["sensing.position_delay.base_position=2"]
            given += [f"estimator.velocity_bias_walk.base_rotation={draw.choice([0.0, 1e-6])}"]
    if law in OF_FRAMES:
        given += frame_of(base)
    return load_scenario(base, [*given, *hard])


def frame_of(base: str):
    """A path of the hand to a place a little away from where it begins."""
    scenario = load_scenario(base)
    model, (instance, name) = make_nominal_plant(scenario), scenario.model.end_effector.split("::")
    hand = model.plant.GetFrameByName(name, model.plant.GetModelInstanceByName(instance))
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    place = [float(x) + 0.02 for x in model.calc_frame_pose(q, hand)[4:]]
    goal = {"frame": scenario.model.end_effector, "task": "position", "position": place}
    return [{"reference": {"frame": goal}}]
