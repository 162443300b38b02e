"""Names, texts and numbers that a URDF must not hold are refused before Drake reads them, with
file, part, element and attribute named.
"""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario
from ffsm_drake.common.errors import ModelError
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.plant import make_plant, models_dir

SETTINGS = settings(derandomize=True, database=None, deadline=None, max_examples=60)
GOOD = (models_dir() / "urdf" / "servicer.urdf").read_text()
NUMBERS = [
    match
    for match in re.finditer(r'<(\w+)[^<>]*? (\w+)="([-+0-9.e ]+)"', GOOD)
    if (match[1], match[2]) != ("limit", "velocity") and match[1] != "limit"
]
NAMES = list(re.finditer(r'<(link|joint|frame) name="(\w+)"', GOOD))
BAD = st.sampled_from(
    ["nan", "x", "1e300", "-1e300", "1e400", "inf", "1_0", "\u0661", "0x1p3", "1e16", "1;2"]
)


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    """load(text or bytes): load the spacecraft with that servicer."""
    file = tmp_path_factory.mktemp("urdf") / "servicer.urdf"
    debris = models_dir() / "urdf" / "debris.urdf"
    overrides = [f"model.servicer={file}", f"model.debris={debris}"]

    def run(content, make=make_plant):
        file.unlink(missing_ok=True)
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return make(load_scenario("postcapture", overrides).model)

    return run


@SETTINGS
@given(st.sampled_from(NUMBERS), st.integers(0, 3), BAD)
def test_bad_numbers(load, found, at, bad):
    parts = found[3].split()
    parts[at % len(parts)] = bad
    text = GOOD[: found.start(3)] + " ".join(parts) + GOOD[found.end(3) :]
    with pytest.raises(
        ModelError, match=rf"servicer\.urdf: \w+ '\w+': <{found[1]} {found[2]}> must"
    ):
        load(text)


TRANSMISSION = """<transmission name="t">
  <type>transmission_interface/SimpleTransmission</type>
  <joint name="joint_1"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
  <actuator name="m"><mechanicalReduction>1</mechanicalReduction>
    <drake:rotor_inertia xmlns:drake="http://drake.mit.edu" value="{}"/></actuator>
</transmission></robot>"""


@SETTINGS
@given(st.floats(1e-6, 1e9), st.sampled_from(["rotor_inertia value", "dynamics damping"]))
def test_numbers_that_must_not_be_negative(load, size, of):
    def with_value(value):
        if of == "dynamics damping":
            return re.sub(
                r'(<joint name="joint_1"[^>]*>)', rf'\1<dynamics damping="{value}"/>', GOOD
            )
        return GOOD.replace("</robot>", TRANSMISSION.format(value))

    load(with_value(0))
    load(with_value(min(size, 1.0)))
    with pytest.raises(ModelError, match=rf"'\w+': <{of}> must be >= 0"):
        load(with_value(-size))


@SETTINGS
@given(st.sampled_from(NAMES), st.sampled_from(["a::b", "::", "servicer::x", " a", "a\u202e", ""]))
def test_bad_names(load, found, bad):
    text = re.sub(rf'"{found[2]}"', f'"{bad}"', GOOD)
    with pytest.raises(ModelError, match=rf"servicer\.urdf: .*{found[1]}.* (name holds|no name)"):
        load(text)


@pytest.mark.long
@SETTINGS
@given(st.text("äöüßéñ", min_size=1, max_size=4), st.sampled_from(["latin-1", "utf-16", "cp1252"]))
def test_other_encodings(load, word, encoding):
    text = GOOD.replace("<robot", f"<!-- {word} -->\n<robot", 1)
    load(text)
    declared = text.replace('version="1.0"', f'version="1.0" encoding="{encoding}"')
    for each in (text, declared):
        with pytest.raises(ModelError, match=r"servicer\.urdf: line \d+: is not UTF-8 text"):
            load(each.encode(encoding))


@pytest.mark.parametrize("word", ["cafe", "café"])
@pytest.mark.parametrize(
    ("encoding", "right"),
    [
        ("utf-8", ("cafe", "café")), ("UTF8", ("cafe", "café")), ("us-ascii", ("cafe",)),
        ("ISO-8859-1", ("cafe",)), ("windows-1252", ("cafe",)), ("utf-16", ()), ("IBM037", ()),
        ("nosuch", ()), ("hex", ()), ("", ()),
    ],
)  # fmt: skip
def test_declared_encodings(load, encoding, right, word):
    """Files are read as UTF-8: refused is what means another text."""
    text = GOOD.replace('version="1.0"', f"version='1.0' encoding='{encoding}'")
    text = text.replace("<robot", f"<!-- {word} --><robot", 1)
    assert encoding in text
    if word in right:
        load(text)
    else:
        with pytest.raises(ModelError, match=rf"servicer\.urdf: declares .* '{encoding}'; save it"):
            load(text)


@pytest.mark.parametrize("side", ["1e300", "1e-300", "0", "-1"])
def test_boxes_that_no_distance_can_be_measured_to(load, side):
    text = re.sub(r'<box size="[^"]*"', f'<box size="1 {side} 1"', GOOD)
    assert text != GOOD
    with pytest.raises(ModelError, match="<box size> must be"):
        load(text, Clearance)


def test_long_chains_and_entities(load):
    links = "".join(f'<link name="l{k}"/>' for k in range(400))
    with pytest.raises(ModelError, match="links; at most 300 are read"):
        load(GOOD.replace("</robot>", links + "</robot>"))
    with pytest.raises(ModelError, match="has a <!DOCTYPE"):
        load(GOOD.replace("<robot", '<!DOCTYPE r [<!ENTITY a "b">]>\n<robot', 1))


DIRECTIVES = (models_dir() / "postcapture.dmd.yaml").read_text()
POSE = """<sdf version="1.9"><model name="debris"><pose>{} 0 0 0 0 0</pose>
<link name="debris"/><frame name="grasp"/></model></sdf>"""
FRAME = """- add_frame:
    name: more
    X_PF: {{base_frame: servicer::base, translation: [0, {}, 0], rotation: !Rpy {{deg: [1, 2, 3]}}}}
"""


@pytest.mark.long
@settings(SETTINGS, max_examples=20)
@given(st.sampled_from(["1e300", "-1e300", "1e400", "inf", "-inf", "10001"]), st.booleans())
def test_places_of_directives_and_sdf(tmp_path_factory, number, sdf):
    folder = tmp_path_factory.mktemp("model")
    file, debris = folder / "m.dmd.yaml", folder / "debris.sdf"
    text = DIRECTIVES + FRAME.format("1" if sdf else number.replace("inf", ".inf"))
    if sdf:
        debris.write_text(POSE.format(number))
        text = text.replace("package://ffsm_drake/urdf/debris.urdf", debris.as_uri())
    file.write_text(text)
    model = load_scenario("postcapture", [f"model.directives={file}"]).model
    with pytest.raises(ModelError, match=r"line \d+: .* must be (at most 10000 m|finite)"):
        make_plant(model)
    file.write_text(DIRECTIVES + FRAME.format("1.5"))
    make_plant(model)


def test_encodings_of_directives(tmp_path):
    file = tmp_path / "m.dmd.yaml"
    file.write_bytes(DIRECTIVES.encode() + "# café\n".encode("latin-1"))
    model = load_scenario("postcapture", [f"model.directives={file}"]).model
    with pytest.raises(ModelError, match=r"m\.dmd\.yaml: line \d+: is not UTF-8 text"):
        make_plant(model)
    file.write_text(DIRECTIVES + "# café\n")
    make_plant(model)
