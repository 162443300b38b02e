"""URDFs as users bring them: plain text, written here link by link."""

BOX = {"mass": 300.0, "inertia": (120.0, 120.0, 90.0)}


def link(name, *, mass=None, inertia=(0.1, 0.1, 0.05), com=(0.0, 0.0, 0.0), extra=""):
    if mass is None:
        return f'<link name="{name}">{extra}</link>'
    ixx, iyy, izz = inertia
    return (
        f'<link name="{name}"><inertial><origin xyz="{com[0]} {com[1]} {com[2]}"/><mass '
        f'value="{mass}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" '
        f'iyz="0"/></inertial>{extra}</link>'
    )


def joint(
    name,
    parent,
    child,
    *,
    kind="revolute",
    axis="0 0 1",
    xyz="0 0 0",
    rpy="0 0 0",
    limit="",
    extra="",
):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    axis = "" if kind == "fixed" else f'<axis xyz="{axis}"/>'
    limit = f"<limit {limit}/>" if limit else ""
    return (
        f'<joint name="{name}" type="{kind}">{ends}<origin xyz="{xyz}" '
        f'rpy="{rpy}"/>{axis}{limit}{extra}</joint>'
    )


def robot(*parts, name="mine"):
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"


TURN = 'lower="-2.9" upper="2.9" effort="80" velocity="1.5"'


def rod(name, length, mass, **extra):
    """A link along z: a solid cylinder of radius 0.05 m."""
    across = mass * (length**2 / 12.0 + 0.05**2 / 4.0)
    return link(
        name,
        mass=mass,
        inertia=(across, across, 0.5 * mass * 0.05**2),
        com=(0.0, 0.0, 0.5 * length),
        **extra,
    )


def six_joints():
    """A 6-joint arm on a box, with what ROS tools add: transmissions, simulator tags, friction,
    lost meshes.
    """
    lost = (
        '<visual><geometry><mesh filename="package://nowhere/a.stl"/></geometry></visual>'
        '<collision><geometry><mesh filename="package://nowhere/a.stl"/></geometry></collision>'
    )
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    lengths = (0.2, 0.8, 0.7, 0.15, 0.15, 0.1)
    parts = [link("bus", **BOX, extra=lost)]
    parent, height = "bus", 0.6
    for k, (axis, length) in enumerate(zip(axes, lengths, strict=True), start=1):
        parts += [
            rod(f"link_{k}", length, 12.0 * length + 2.0, extra=lost),
            joint(
                f"arm_{k}",
                parent,
                f"link_{k}",
                axis=axis,
                xyz=f"0 0 {height}",
                limit=TURN,
                extra='<dynamics damping="0.7" friction="0.1"/><safety_controller '
                'k_velocity="10"/>',
            ),
            f'<transmission name="t{k}"><joint name="arm_{k}"/><actuator '
            f'name="m{k}"/></transmission>',
        ]
        parent, height = f"link_{k}", length
    parts += [link("tool0"), joint("tool_joint", parent, "tool0", kind="fixed", xyz="0 0 0.1")]
    parts += ['<gazebo reference="bus"><material>Gazebo/Blue</material></gazebo>']
    return robot(*parts)


def arm_alone(*, stand=True):
    """The kinematics and masses of Universal Robots' UR5, as ROS publishes them: an arm fixed to
    the world.
    """
    turn = 'lower="-6.283" upper="6.283" effort="150" velocity="3.14"'
    right, y = "0 1.570796325 0", "0 1 0"
    chain = (
        ("shoulder_pan", "shoulder", 3.7, "0 0 0.089159", "0 0 0", "0 0 1"),
        ("shoulder_lift", "upper_arm", 8.393, "0 0.13585 0", right, y),
        ("elbow", "forearm", 2.275, "0 -0.1197 0.425", "0 0 0", y),
        ("wrist_1", "wrist_1_link", 1.219, "0 0 0.39225", right, y),
        ("wrist_2", "wrist_2_link", 1.219, "0 0.093 0", "0 0 0", "0 0 1"),
        ("wrist_3", "wrist_3_link", 0.1879, "0 0 0.09465", "0 0 0", y),
    )
    parts, parent = [rod("base_link", 0.1, 4.0)], "base_link"
    if stand:
        parts += [
            link("world"),
            joint("world", "world", "base_link", kind="fixed", xyz="0.2 0 0.05", rpy="0 0 0.5"),
        ]
    for name, child, mass, xyz, rpy, axis in chain:
        parts += [
            rod(child, 0.15, mass),
            joint(f"{name}_joint", parent, child, axis=axis, xyz=xyz, rpy=rpy, limit=turn),
        ]
        parent = child
    return robot(
        *parts,
        link("tool0"),
        joint("tool", parent, "tool0", kind="fixed", xyz="0 0.0823 0"),
        name="ur5",
    )


def stage(*extra, frame='<frame name="handle" link="tank" xyz="0 0 -1.5" rpy="0 0 0"/>'):
    """A target: a tank whose centre of mass and principal axes are off its frame, and a nozzle
    without mass.
    """
    inertial = (
        '<inertial><origin xyz="0.1 0 0.2" rpy="0 0 1.5707963267948966"/><mass value="250"/>'
        '<inertia ixx="180" iyy="120" izz="90" ixy="0" ixz="10" iyz="0"/></inertial>'
    )
    nozzle = joint("nozzle_joint", "tank", "nozzle", kind="fixed", xyz="0 0 1.5")
    return robot(
        f'<link name="tank">{inertial}</link>', link("nozzle"), nozzle, frame, *extra, name="stage"
    )


def prismatic():
    """A turning post with a telescopic boom and a wrist; continuous first joint; a heavy hull."""
    return robot(
        link("hull", mass=900.0, inertia=(400.0, 420.0, 380.0)),
        rod("post", 0.4, 20.0),
        rod("boom", 1.0, 15.0),
        rod("slider", 0.9, 8.0),
        rod("wrist", 0.2, 3.0),
        joint("turn", "hull", "post", kind="continuous", xyz="0 0 0.8"),
        joint("lift", "post", "boom", axis="0 1 0", xyz="0 0 0.4",
              limit='lower="0" upper="1.8" effort="200" velocity="1"'),
        joint("slide", "boom", "slider", kind="prismatic", xyz="0 0 0.3",
              limit='lower="0" upper="0.8" effort="150" velocity="0.2"'),
        joint("tilt", "slider", "wrist", axis="0 1 0", xyz="0 0 0.9", limit=TURN),
    )  # fmt: skip


def gripper():
    """A 3-joint arm whose hand has two sliding fingers, the second a mimic; light."""
    finger = 'lower="0" upper="0.04" effort="20" velocity="0.1"'
    return robot(
        link("platform", mass=60.0, inertia=(4.0, 4.0, 3.5)),
        rod("upper", 0.5, 3.0),
        rod("fore", 0.4, 2.0),
        link("hand", mass=1.0, inertia=(0.004, 0.004, 0.003)),
        link("finger_a", mass=0.1, inertia=(1e-4, 1e-4, 5e-5)),
        link("finger_b", mass=0.1, inertia=(1e-4, 1e-4, 5e-5)),
        joint("shoulder", "platform", "upper", axis="0 1 0", xyz="0.2 0 0.3", limit=TURN),
        joint("elbow", "upper", "fore", axis="0 1 0", xyz="0 0 0.5", limit=TURN),
        joint("roll", "fore", "hand", axis="0 0 1", xyz="0 0 0.4", limit=TURN),
        joint(
            "grip_a",
            "hand",
            "finger_a",
            kind="prismatic",
            axis="0 1 0",
            xyz="0 0 0.08",
            limit=finger,
        ),
        joint(
            "grip_b",
            "hand",
            "finger_b",
            kind="prismatic",
            axis="0 -1 0",
            xyz="0 0 0.08",
            limit=finger,
            extra='<mimic joint="grip_a" multiplier="1"/>',
        ),
    )


def two_armed():
    """Two arms on one body, the left one longer."""
    parts = [link("torso", mass=450.0, inertia=(200.0, 180.0, 210.0))]
    for side, y, lengths in (("right", -0.5, (0.7, 0.6, 0.2)), ("left", 0.5, (0.9, 0.8, 0.3))):
        parent, at = "torso", f"0 {y} 0.5"
        for part, axis, length in zip(
            ("shoulder", "elbow", "wrist"), ("1 0 0", "0 1 0", "0 1 0"), lengths, strict=True
        ):
            name = f"{side}_{part}"
            parts += [
                rod(f"{name}_link", length, 10.0 * length),
                joint(name, parent, f"{name}_link", axis=axis, xyz=at, limit=TURN),
            ]
            parent, at = f"{name}_link", f"0 0 {length}"
        parts += [
            link(f"{side}_tool"),
            joint(f"{side}_mount", parent, f"{side}_tool", kind="fixed", xyz=at),
        ]
    return robot(*parts)


def seven_joints():
    """Seven joints with offsets and turned frames, the usual redundant arm; a massless root before
    the bus.
    """
    turned = (
        "0 0 0",
        "-1.5708 0 0",
        "1.5708 0 0",
        "1.5708 0 0",
        "-1.5708 0 0",
        "1.5708 0 0",
        "1.5708 0 0",
    )
    offsets = (
        "0.1 0 0.5",
        "0 0.1 0",
        "0 -0.42 0.05",
        "0.08 0 0",
        "-0.08 0.38 0",
        "0 0 0.06",
        "0.09 0 0.1",
    )
    masses = (6.0, 6.0, 5.0, 5.0, 3.5, 3.0, 1.5)
    parts = [
        link("base_link"),
        link("bus", mass=220.0, inertia=(60.0, 70.0, 55.0)),
        joint("base_to_bus", "base_link", "bus", kind="fixed", xyz="0 0 -0.1"),
    ]
    parent = "base_link"
    for k, (rpy, xyz, mass) in enumerate(zip(turned, offsets, masses, strict=True), start=1):
        parts += [
            link(
                f"l{k}",
                mass=mass,
                inertia=(0.03 * mass, 0.03 * mass, 0.02 * mass),
                com=(0.01, 0.02, 0.05),
            ),
            joint(
                f"j-{k}",
                parent,
                f"l{k}",
                xyz=xyz,
                rpy=rpy,
                limit=TURN if k % 2 else TURN.replace("2.9", "1.9"),
            ),
        ]
        parent = f"l{k}"
    parts += ['<frame name="grasp_point" link="l7" xyz="0 0 0.12" rpy="0 0 0"/>']
    return robot(*parts)


def simple_arm(*more, **limits):
    """Two joints on a box, and whatever else is given."""
    limit = " ".join(f'{key}="{value}"' for key, value in limits.items())
    return robot(
        link("bus", **BOX),
        rod("upper", 1.0, 10.0),
        rod("fore", 1.0, 10.0),
        joint("shoulder", "bus", "upper", axis="0 1 0", xyz="0 0 0.6", limit=limit),
        joint("elbow", "upper", "fore", axis="0 1 0", xyz="0 0 1", limit=limit),
        *more,
    )


OUTSIDE = {f.__name__: f for f in (six_joints, prismatic, gripper, two_armed, seven_joints)}


def two_hands(axes, *, other=None, torso=False, reach=1.6):
    """Two arms at the sides of a bus, joints about the given axes, with a torso in between."""
    limit = 'lower="-2.6" upper="2.6" effort="60" velocity="1"'
    parts, root = [link("bus", mass=200, inertia=(40, 40, 40))], "bus"
    if torso:
        parts += [
            link("torso", mass=10, inertia=(1, 1, 1)),
            joint("waist", "bus", "torso", axis="0 0 1", xyz="0 0 0.4", limit=limit),
        ]
        root = "torso"
    along = "0 {0} 0" if set(axes) <= {"z"} else "0 0 {0}"
    for side, given in (("left", axes), ("right", other or axes)):
        parent, at = root, f"{-0.5 if side == 'left' else 0.5} 0 0.3"
        for k, axis in enumerate(given):
            name, length = f"{side}_{k + 1}", reach / len(given)
            turned = " ".join("1" if axis == each else "0" for each in "xyz")
            parts += [
                link(name, mass=2, inertia=(0.02, 0.02, 0.02)),
                joint(f"{name}_joint", parent, name, axis=turned, xyz=at, limit=limit),
            ]
            parent, at = name, along.format(length)
        parts += [
            link(f"{side}_hand"),
            joint(f"{side}_palm", parent, f"{side}_hand", kind="fixed", xyz=at),
        ]
    return robot(*parts)
