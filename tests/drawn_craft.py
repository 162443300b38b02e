"""Spacecraft drawn at random, with the options of ``ffsm new`` that start a capture with them."""

import random

from outside_urdfs import joint, link, robot


def box(name: str, mass: float, sides: tuple[float, float, float], foot: float = 0.0) -> str:
    """A link that is a box standing on its frame, or with ``foot`` below the frame, m."""
    x, y, z = sides
    moments = (y * y + z * z, x * x + z * z, x * x + y * y)
    middle = (0.0, 0.0, 0.5 * z - foot)
    place = " ".join(map(str, middle))
    drawn = (
        f'<visual><origin xyz="{place}"/><geometry><box size="{x} {y} {z}"/></geometry></visual>'
    )
    inertia = tuple(mass * each / 12.0 for each in moments)
    return link(name, mass=mass, inertia=inertia, com=middle, extra=drawn)


def drawn_craft(seed: int) -> tuple[str, dict[str, str]]:
    """A spacecraft (URDF) with 4 to 7 joints, of which one may slide, and the options.

    Masses, lengths, limits, friction, target, tumble, sensors and actuators vary.
    """
    draw = random.Random(seed)
    mass = round(60.0 * 25.0 ** draw.random(), 1)
    side = (mass / 240.0) ** (1.0 / 3.0)
    sides = tuple(round(side * draw.uniform(0.8, 1.2), 3) for _ in range(3))
    number = draw.randint(4, 7)
    slide = draw.choice([0, 0, draw.randint(2, number - 1)])  # which joint slides; 0: none
    scale, has_friction = (mass / 250.0) ** (1.0 / 3.0), draw.random() < 0.5
    parts, parent, foot = [box("bus", mass, sides, 0.5 * sides[2])], "bus", 0.5 * sides[2]
    for k in range(1, number + 1):
        share = 1.0 - (k - 1) / number
        length = round(scale * draw.uniform(0.15, 0.9) * (0.4 + share), 3)
        wide = round(0.15 * scale * (0.5 + 0.5 * share), 3)
        parts.append(box(f"link_{k}", round(1.0 + 20.0 * length * scale**2, 2),
                         (wide, wide, length)))  # fmt: skip
        turn, slow = round(draw.uniform(1.3, 3.1), 2), round(draw.uniform(0.2, 1.0), 2)
        effort = round(100.0 * scale**3 * draw.uniform(0.3, 1.0) * (0.2 + share), 1)
        span = (-turn, turn, effort, slow)
        if k == slide:
            span = (0.0, round(draw.uniform(0.3, 1.0), 2), round(3.0 * effort, 1),
                    round(draw.uniform(0.05, 0.3), 2))  # fmt: skip
        lower, upper, most, rate = span
        friction = f'<dynamics damping="{0.01 * most:.3g}" friction="{0.005 * most:.3g}"/>'
        axis = ("0 0 1" if k == slide else
                draw.choice(["0 1 0", "1 0 0"]) if k % 3 else "0 0 1")  # fmt: skip
        parts.append(joint(
            f"j{k}", parent, f"link_{k}", kind="prismatic" if k == slide else "revolute",
            axis=axis, xyz=f"0 0 {foot}", extra=friction if has_friction else "",
            limit=f'lower="{lower}" upper="{upper}" effort="{most}" velocity="{rate}"',
        ))  # fmt: skip
        parent, foot = f"link_{k}", length
    parts += [link("tool"), joint("jt", parent, "tool", kind="fixed", xyz=f"0 0 {foot}")]
    thrust = f"16x{0.008 * mass * draw.uniform(0.7, 2.0):.2g}N"
    drawn = {
        "target": f"{mass * draw.uniform(0.05, 0.5):.3g}",
        "capture": f"{draw.uniform(0.5, 6.0):.2g}deg/s",
        "sensors": draw.choice(["", "flight"]),
        "thrusters": draw.choice(["", "12", thrust]),
        "wheels": draw.choice(["", "3", "4"]),
        "panels": draw.choice(["", f"2x{0.012 * mass:.2g}kg"]),
    }
    return robot(*parts, name="drawn"), {key: word for key, word in drawn.items() if word}
