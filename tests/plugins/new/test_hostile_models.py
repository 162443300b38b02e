"""Model files that would run commands, hang, crash or take all memory."""

import contextlib
import io
import os
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from children import PIPE, child
from drawn_models import (
    HEADER,
    MJCF,
    SDF,
    VALID,
    harmless_expression,
    hostile_expression,
    hostile_model,
    mutated,
    urdf,
)

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new import apart
from ffsm_drake.plugins.new.urdf import formats
from ffsm_drake.plugins.new.urdf.formats.located import keep_lines, read_located
from ffsm_drake.plugins.new.urdf.formats.xacro import expand
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.plugins.new.urdf.target import read_target
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.plant import make_plant

xacro = pytest.importorskip("xacro")
pytest.importorskip("mujoco")

# Draws of each test; more of them: FFSM_DRAWS=2000 pytest tests/plugins/new/test_hostile_models.py
DRAWS = int(os.environ.get("FFSM_DRAWS", "0"))
NAMES = {"x": "3", "y": "'q'", "names": "${['a', 'b']}", "table": "${dict(k=2)}"}
_started = list[str]()
_watching = [False]


def _audit(event: str, _: object) -> None:
    if _watching[0] and event.startswith(
        ("os.system", "os.exec", "os.spawn", "os.posix", "subproc")
    ):
        _started.append(event)


sys.addaudithook(_audit)


@contextlib.contextmanager
def nothing_starts():
    _started.clear()
    _watching[0] = True
    try:
        yield
    finally:
        _watching[0] = False
    assert not _started


@pytest.fixture
def apart_for_good(monkeypatch):
    """Models are read in a process of their own, as by commands."""
    monkeypatch.setattr(formats, "answer", apart.answer)


def quoted(text):
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


@pytest.mark.filterwarnings("ignore::SyntaxWarning")
def test_harmless_expressions_have_the_value_that_xacro_gives(tmp_path):
    rng, seen = np.random.default_rng(1), 0
    properties = "".join(f'<xacro:property name="{k}" value="{v}"/>' for k, v in NAMES.items())
    symbols = xacro.Table(xacro._global_symbols)
    for name, value in NAMES.items():
        symbols[name] = value
    xacro.init_stacks("c.xacro")
    while seen < (DRAWS or 60):
        expression = harmless_expression(rng)
        try:
            with contextlib.redirect_stderr(io.StringIO()):  # names that are deprecated
                expected = str(xacro.safe_eval(expression, symbols))
        except Exception:  # a division by zero and such
            expected = None
        if expected is None or "}" in expression or "abs_filename" in expression:
            continue
        seen += 1
        file = tmp_path / "c.xacro"
        file.write_text(f'{HEADER}{properties}<a b="${{{quoted(expression)}}}"/></robot>')
        found = expand(file, {}, {}, trust=False)
        assert f'b="{quoted(expected).replace(">", "&gt;")}"' in found, expression


PLACES = (
    '<xacro:property name="p" value="${{{0}}}"/>${{p}}',
    '<a b="${{{0}}}"/>', "${{{0}}}", "$(eval {0})",
    '<xacro:if value="${{{0}}}"><a/></xacro:if>', '<xacro:arg name="q" default="${{{0}}}"/>',
    '<xacro:macro name="m" params="u:=${{{0}}}"><a b="${{u}}"/></xacro:macro><xacro:m/>',
    '<xacro:property name="a" value="{0}"/><xacro:property name="d" value="$"/><a b="${{a}}"/>'
    '<b c="${{${{a}}}}"/>',
    '<xacro:include filename="${{{0}}}"/>', '<xacro:element xacro:name="${{{0}}}"/>',
    '<!-- xacro:eval-comments --><!-- ${{{0}}} --><a/>', '<xacro:call macro="${{{0}}}"/>',
    '<xacro:property name="a" value="${{1}}" lazy_eval="${{{0}}}"/>',
    '<xacro:attribute name="n" value="${{{0}}}"/>',
)  # fmt: skip


def test_no_hostile_expression_runs_anything(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(2)
    for k in range(DRAWS or 120):
        expression = hostile_expression(rng, "touch PWNED")
        text = PLACES[k % len(PLACES)].format(quoted(expression))
        kind = ("c.xacro", "c.urdf")[int(rng.integers(2))]
        Path(kind).write_text(urdf(text))
        read = (read_urdf, read_target)[int(rng.integers(2))]
        with nothing_starts(), contextlib.suppress(ModelError):
            read(Path(kind))
        assert not Path("PWNED").exists(), text


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("${(lambda: 1)()}", "a Lambda is not allowed"),
        ("${''.join}", "'.join' is not allowed"),
        ("${math.__dict__}", "'__dict__' is not allowed"),
        ("${9**9**9}", "bits"),
        ("${'a' * 10**10}", "items"),
        ("${xacro.load_yaml('a.yaml')}", "--trust"),
        ("$(env HOME)", "--trust"),
        ("$(optenv HOME)", "--trust"),
        ('<xacro:include filename="../secret.xacro"/>', "outside the model's folder"),
        ('<xacro:include filename="c.xacro"/>', "more than 50 deep"),
        ('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>', "nest too deeply"),
        ('<xacro:include filename="fifo"/>', "is not a regular file"),
        ('<xacro:include filename="$(find none)/a.xacro"/>', "give --package none=FOLDER"),
        ('<xacro:include filename="none.xacro"/>', "cannot be expanded: No such file"),
        ('<xacro:arg name="a" default="1"/>${b}', "cannot be expanded: name 'b' is not defined"),
        ('<link name="$(arg b)"/>', "1 argument missing, without a default: give --xacro-arg b="),
    ],
)
def test_what_a_xacro_file_must_not_do(text, told, tmp_path):
    folder = tmp_path / "robot"
    folder.mkdir()
    (tmp_path / "secret.xacro").write_text("<robot/>")
    os.mkfifo(folder / "fifo")
    (folder / "c.xacro").write_text(urdf(text))
    with pytest.raises(ModelError) as error:
        read_urdf(folder / "c.xacro")
    assert str(error.value).count(told) == 1, error.value
    assert "<class" not in str(error.value)


def test_a_trusted_file_reads_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("FFSM_MASS", "7")
    (tmp_path / "robot").mkdir()
    (tmp_path / "more.yaml").write_text("{mass: {arm: 5}}")
    (tmp_path / "more.xacro").write_text(f'{HEADER}<xacro:property name="m" value="3"/></robot>')
    (tmp_path / "robot/c.xacro").write_text(
        urdf(
            '<xacro:include filename="../more.xacro"/><frame name="${m}$(env FFSM_MASS)'
            '${xacro.load_yaml(\'../more.yaml\').mass.arm}" link="l2"/>'
        )
    )
    found = read_urdf(tmp_path / "robot/c.xacro", trust=True)
    assert found.root.find("frame").get("name") == "375"


def test_only_what_is_declared_xacro_is_expanded(tmp_path):
    (tmp_path / "c.urdf").write_text(
        urdf("<a>${1 + 1}</a>").replace(' xmlns:xacro="http', ' x="http')
    )
    assert read_urdf(tmp_path / "c.urdf").root.find("a").text == "${1 + 1}"
    (tmp_path / "c.urdf").write_text(urdf("<a>${1 + 1}</a>"))
    assert read_urdf(tmp_path / "c.urdf").root.find("a").text == "2"


def test_lines_stay_where_elements_are_removed(tmp_path):
    file, rng = tmp_path / "a.xml", np.random.default_rng(3)

    def drawn(depth):
        space = rng.choice(["", "\n", "\n\n ", "\n<!-- a\nb -->\n"], size=5).tolist()
        inside = (
            "".join(space[k] + drawn(depth - 1) for k in range(rng.integers(4)))
            if depth
            else "1\n2"
        )
        return f"<a>{inside}{space[4]}</a>"

    for _ in range(DRAWS or 40):
        file.write_text("<?xml version='1.0' encoding='UTF-8'?>\n<!-- \n -->\n" + drawn(3))
        root, lines = read_located(file)
        for element in list(root.iter()):
            for each in [each for each in element if rng.random() < 0.3]:
                element.remove(each)
        keep_lines(root, lines)
        above = b"\n" * (lines[root] - 1)
        file.write_bytes(above + formats.ElementTree.tostring(root))
        again, found = read_located(file)
        assert [found[each] for each in again.iter()] == [lines[each] for each in root.iter()]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<pose>0 0 0 0 0 0</pose>", "<pose>a 0 0 0 0 0</pose>", "<pose> must be"),
        ("<diffuse>1", "<diffuse>a", "line {line}: <diffuse> must be"),
        ("<lower>-1", "<lower>NaN", "line {line}: <lower> must be a number, not 'NaN'"),
        ("<ixx>1<", "<ixx>1e999<", "<ixx> must be finite"),
        ('version="1.7"', 'version="x"', "<sdf version>"),
        ("<mass>5", "<what/><mass>5", "craft.sdf:{line}"),
        ("</model>", '<joint name="z" type="revolute"><parent>l2</parent><child>l0</child><axis>'
         "<xyz>0 1 0</xyz></axis></joint></model>", "form a loop"),
    ],
)  # fmt: skip
def test_faults_of_sdformat_are_told_with_their_lines(old, new, told, tmp_path):
    (tmp_path / "craft.sdf").write_text(SDF.replace(old, new, 1))
    with pytest.raises(ModelError) as error:
        read_urdf(tmp_path / "craft.sdf")
    line = SDF[: SDF.index(old)].count("\n") + 1
    assert told.format(line=line) in str(error.value), error.value


DECLARED = '<?xml version="1.0"?>\n'


@pytest.mark.parametrize(("name", "text"), [("a.xml", MJCF), ("a.sdf", SDF), ("a.urdf", urdf())])
def test_declared_encodings(name, text, tmp_path):
    file = tmp_path / name
    file.write_text(f'<?xml version="1.0" encoding="nosuch"?>{text.removeprefix(DECLARED)}')
    with pytest.raises(ModelError, match="declares the encoding 'nosuch'; save it as UTF-8"):
        read_urdf(file)
    given = {"servicer": str(file), "debris": "package://ffsm_drake/urdf/debris.urdf"}
    with pytest.raises(ModelError, match="declares the encoding 'nosuch'; save it as UTF-8"):
        make_plant(Model(**given, end_effector="servicer::l3", grasp="debris::grasp"))


def test_joints_that_follow_each_other(tmp_path):
    loop = '<equality><joint joint1="j0" joint2="j1"/><joint joint1="j1" joint2="j0"/></equality>'
    (tmp_path / "a.xml").write_text(MJCF.replace("<equality>", f"{loop}<equality>"))
    with pytest.raises(ModelError, match="joints j0, j1 follow each other"):
        read_urdf(tmp_path / "a.xml")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('count="2"', 'count="1000000000"', "<replicate> would make 1e+09 parts"),
        ('nkey="1"', 'nkey="1000000000"', "<size nkey> is 1e"),
        ("<asset/>", '<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>',
         "<hfield nrow ncol>"),
        ("<worldbody>", '<include file="fifo"/><worldbody>', "fifo: is not a regular file"),
    ],
)  # fmt: skip
def test_counts_are_bounded_before_mujoco_compiles(old, new, told, tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "a.xml").write_text(MJCF.replace(old, new))
    with pytest.raises(ModelError) as error:
        read_urdf(tmp_path / "a.xml")
    assert told in str(error.value)


def test_a_fifo_is_none(tmp_path):
    file = tmp_path / "a.urdf"
    os.mkfifo(file)
    model = Model(servicer=str(file), debris="package://ffsm_drake/urdf/debris.urdf")
    for read in (read_urdf, read_target, lambda _: make_plant(model)):
        with pytest.raises(ModelError, match=r"a\.urdf: cannot be read: is not a regular file"):
            read(file)


@pytest.mark.parametrize(
    ("limits", "found"),
    [
        ('lower="-1.79e308" upper="1.79e308" effort="1e300" velocity="1e16"', (-np.inf, np.inf)),
        ('lower="-1.79e308" upper="1"', (-1e4, 1.0)),
    ],
)
def test_huge_limits_are_none(limits, found, tmp_path):
    text = (
        urdf().replace('lower="-1" upper="1"', limits, 1).replace('effort="10" velocity="1"', "", 1)
    )
    (tmp_path / "a.urdf").write_text(text)
    servicer = read_urdf(tmp_path / "a.urdf")
    first, *_ = servicer.joints
    assert (first.lower, first.upper) == found
    assert "limits beyond 1e+16 do not limit: lower of j0" in servicer.remarks[0]
    assert first.effort == first.velocity == np.inf


def readers_left(leader, *, of="session"):
    """Processes that read models, of a session, or of a parent process."""
    found = set()
    for each in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            told = (each / "stat").read_text().rpartition(")")[2].split()
            its = int(told[3 if of == "session" else 1])
            if its == leader and b"plugins.new.apart" in (each / "cmdline").read_bytes():
                found.add(each.name)
    return found


def endless(folder):
    """A xacro file that splits a text by an expression that tries all ways."""
    file = folder / "craft.xacro"
    text = f"${{xacro.tokenize(' {'a' * 60}c', ' ](a|a)*b[ ')}}"
    file.write_text(urdf(text))
    return file


@pytest.mark.smoke
def test_a_reader_that_hangs_is_ended(tmp_path, monkeypatch, apart_for_good):
    monkeypatch.setattr(apart, "DEADLINE", 2.5)
    with pytest.raises(ModelError, match=r"craft.xacro: is not read within 2.5 s"):
        read_urdf(endless(tmp_path))


@pytest.mark.slow
def test_a_model_that_includes_itself_is_refused(tmp_path):
    file = tmp_path / "a.sdf"
    file.write_text(SDF.replace("</model>", f"<include><uri>file://{file}</uri></include></model>"))
    with pytest.raises(ModelError, match=r"model.servicer.*<include> of a.sdf includes itself"):
        make_plant(Model(servicer=str(file)))


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, marks=pytest.mark.long),
        pytest.param(signal.SIGKILL, marks=pytest.mark.long),
    ],
)
def test_a_signal_ends_a_command_and_its_reader(number, tmp_path):
    file = endless(tmp_path)
    command = [
        sys.executable,
        "-m",
        "ffsm_drake",
        "new",
        str(tmp_path / "out"),
        "--model",
        str(file),
    ]
    with child(command, stdout=PIPE, stderr=PIPE) as process:
        while not readers_left(process.pid):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.1)
        time.sleep(1.0)
        begun = time.monotonic()
        process.send_signal(number)
        process.wait(timeout=10.0)
        while left := readers_left(process.pid):
            assert time.monotonic() - begun < 10.0, left
            time.sleep(0.05)
    assert process.returncode in (128 + number, -number)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        pytest.param("urdf", mutated, marks=pytest.mark.slow),
        *(pytest.param(kind, mutated, marks=pytest.mark.long) for kind in VALID if kind != "urdf"),
        *(pytest.param(kind, hostile_model, marks=pytest.mark.long) for kind in VALID),
    ],
)
def test_mutated_and_hostile_models_end(kind, make, tmp_path, monkeypatch, apart_for_good):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(apart, "DEADLINE", 20.0)
    os.mkfifo(tmp_path / "fifo")
    more = {} if make is mutated else {"folder": tmp_path}
    rng, draws, told, longest = np.random.default_rng(4), DRAWS or 2, list[str](), 0.0
    for k in range(draws):
        file = tmp_path / f"a.{kind}"
        file.write_bytes(make(rng, kind=kind, **more))
        begun = time.monotonic()
        try:
            (read_urdf, read_target)[k % 2](file)
        except ModelError as error:
            told.append(str(error))
        longest = max(longest, time.monotonic() - begun)
        assert longest < 120.0, file.read_bytes()
        assert not readers_left(os.getpid(), of="parent")
    for each in told:
        assert "\n" not in each
        assert not re.search(r"Traceback|[a-z]Error:", each)
    print(kind, f"{draws - len(told)} read, {len(told)} refused, at most {longest:.1f} s")
