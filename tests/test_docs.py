"""The documentation speaks of this package: its commands exist, its examples run, its reference is
complete.

That the site builds, with all links inside it, is ``sphinx-build -W``'s to say.
"""

import ast
import functools
import importlib
import importlib.util
import json
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import click
import numpy as np
import pytest
from c_code import needs_llvm
from click.testing import CliRunner
from entry_points import is_there, needs
from PIL import Image
from scipy.optimize import brentq

import ffsm_drake
from ffsm_drake import FfsmError, simulate
from ffsm_drake.cli import main
from ffsm_drake.common.registrations import own_plugins
from ffsm_drake.loop.blocks import BLOCKS
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import (
    Scenario,
    load_scenario,
    scenario_from_dict,
    scenario_from_yaml,
    scenario_to_dict,
    shipped_scenarios,
)
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.systems.controllers import ControlLaw, InjectedDynamics
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.registry import find_factory, shipped_names

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
PAGES += sorted(DOCS.glob("validation/*.md"))
PAGES.append(DOCS / "joss" / "paper.md")
NOT_RUN = "<!-- not run -->"  # on the line before a block
# first line of a python block that is (or continues) a module of the user's
MODULE = re.compile(r"# (\w+)\.py\b")


def blocks(page: Path, language: str) -> list[str]:
    found = re.findall(
        rf"(?:^([^\n]*)\n)?^```{language}\n(.*?)^```",
        page.read_text(),
        flags=re.MULTILINE | re.DOTALL,
    )
    return [text for before, text in found if before.strip() != NOT_RUN]


def shell_commands() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every simple command of the sh blocks, with shell variables replaced by 1."""
    for page in PAGES:
        for block in blocks(page, "sh"):
            for line in re.sub(r"\\\n", " ", block).splitlines():
                lexer = shlex.shlex(
                    re.sub(r"\$\w+", "1", line), posix=True, punctuation_chars=";&|"
                )
                lexer.whitespace_split = True
                words: list[str] = []
                for word in [*lexer, ";"]:
                    if set(word) <= set(";&|"):
                        if words:
                            yield page.name, tuple(words)
                        words = []
                    elif word != "do" or words:
                        words.append(word)


def module_at(path: Path) -> ModuleType:
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def ffsm_parameters(words: tuple[str, ...]) -> dict[str, object]:
    """The parameters of ``ffsm WORDS`` as its command would get them; fails on what the command
    does not know.
    """
    context = main.make_context("ffsm", list(words))
    command, rest = main, list(words)
    while isinstance(command, click.Group):
        name, *rest = rest
        command = command.get_command(context, name)
        assert command is not None, f"no command 'ffsm {' '.join(words)}'"
        context = command.make_context(name, list(rest), parent=context)
    return context.params


def check_overrides(scenario: str, overrides: list[str]) -> None:
    """Shipped scenarios take them; of files and runs that only a page mentions, the schema does."""
    if scenario in shipped_scenarios():
        load_scenario(scenario, overrides)
    else:
        assert scenario.endswith(".yaml") or scenario.startswith("out/"), scenario
        scenario_from_dict({}, overrides)


COMMANDS = sorted(set(shell_commands()))


TESTS = re.compile(r"`pytest ((?:[^`-]|-(?!m ))*?)`")  # without -m: quick tests alone


def slow_tests(command: str) -> list[str]:
    """The tests of a command's files and -k that run with -m only."""
    words, found = shlex.split(command), []
    wanted = words[words.index("-k") + 1] if "-k" in words else ""
    for place in (ROOT / word for word in words if re.match("tests/[a-z]", word)):
        for file in sorted(place.rglob("test_*.py")) if place.is_dir() else [place]:
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                    marks = " ".join(map(ast.unparse, node.decorator_list))
                    if wanted in node.name and re.search(r"mark\.(slow|long|exhaustive)", marks):
                        found.append(node.name)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_tests_run_all_that_they_name(page):
    for command in TESTS.findall(page.read_text()):
        left_out = slow_tests(command)
        assert not left_out, f"pytest {command} leaves out {left_out}; say -m"


def test_slow_tests_are_seen():
    assert "test_it_has_the_bits_of_the_run_with_the_law" in slow_tests("tests/plugins/udp")
    assert not slow_tests("tests/plugins/udp -k misspelt")


def test_commands_are_found():
    """The reader of the pages reads: otherwise the tests below would check nothing."""
    assert sum(words[0] == "ffsm" for _, words in COMMANDS) > 30
    assert sum(words[:2] == ("python", "examples/postcapture.py") for _, words in COMMANDS) > 0
    assert sum(words[:2] == ("python", "-c") for _, words in COMMANDS) > 0


@pytest.mark.parametrize(
    ("page", "words"), [pytest.param(*c, id=f"{c[0]}: {' '.join(c[1])[:60]}") for c in COMMANDS]
)
def test_commands_exist_with_their_options(page, words, capsys, monkeypatch):
    if words[0] == "ffsm":
        parameters = ffsm_parameters(words[1:])
        if "scenario" in parameters:
            given = parameters.get("controller") or ()
            for name in (given,) if isinstance(given, str) else given:
                if ":" not in name:
                    find_factory("controller", name)
            check_overrides(parameters["scenario"], list(parameters["overrides"]))
    elif words[0] == "python" and words[1].startswith("examples/"):
        path = ROOT / words[1]
        assert path.is_file(), f"{page}: {words[1]} does not exist"
        example = module_at(path)
        if words[2:]:
            monkeypatch.setattr(
                example, "run", lambda name, overrides, directory: check_overrides(name, overrides)
            )
            example.main(words[2:])
    elif words[:2] == ("python", "-c"):
        exec(compile(words[2], page, "exec"), {})
        assert capsys.readouterr().out.strip()


@pytest.mark.parametrize(
    "page", [pytest.param(page, id=page.name) for page in PAGES if "![" in page.read_text()]
)
def test_every_picture_opens_and_is_light(page):
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text()):
        file = page.parent / name
        with Image.open(file) as picture:
            picture.load()
        assert file.stat().st_size < 1e6, name


TASKS = ("bring_your_arm", "real_sensors", "catch", "put_on_thrusters", "compare_laws")
TASKS += ("run_thousands",)


@pytest.mark.parametrize("name", TASKS)
def test_task_pages_are_short(name):
    assert len((DOCS / f"{name}.md").read_text().split()) < 600


@pytest.mark.long
@pytest.mark.parametrize("name", TASKS)
def test_every_command_of_a_task_page_runs(name, tmp_path, monkeypatch):
    """In the page's order, in a folder with the files that it says to save. Campaigns have four
    cases, designs four seconds; their maps, pictures, most prices of a design and a report's
    stability section have tests of their own.
    """
    leave_out_what_takes_long(monkeypatch)
    if is_there("campaign"):
        monkeypatch.setattr("ffsm_drake.plugins.campaign.prediction.POINTS", 1)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    shutil.copy(ROOT / "examples/own_sensor.py", tmp_path)
    text = (DOCS / f"{name}.md").read_text()
    for file, content in re.findall(r"^```\w+\n# (\w+\.\w+)\n(.*?)^```", text, re.M | re.S):
        (tmp_path / file).write_text(content)
    commands = [words for page, words in shell_commands() if page == f"{name}.md"]
    assert len(commands) > 3
    for words in commands:
        if words[0] == "python":
            runpy.run_path(words[1], run_name="__main__")
            continue
        if words[:3] == ("ffsm", "campaign", "run"):
            words = (*words, "--cases", "4", "--workers", "1")
        if words[:2] == ("ffsm", "design"):
            words = (*words, "--time", "4")
        result = CliRunner().invoke(main, words[1:], catch_exceptions=False)
        assert result.exit_code == 0, f"{shlex.join(words)}: {result.output}"
        if words[1] == "run":
            assert "Settled: " in result.output, shlex.join(words)


def absent(_):
    raise FfsmError("left out")


def leave_out_what_takes_long(monkeypatch):
    monkeypatch.setattr("ffsm_drake.show.figures.run.save_figures", lambda *_, **__: [])
    if is_there("design"):
        monkeypatch.setattr("ffsm_drake.plugins.design.panels.stability", absent)
        search = importlib.import_module("ffsm_drake.plugins.design.gains.axis_search")
        monkeypatch.setattr(search, "PRICES", search.PRICES[:1])


MARKS = {"api.md": pytest.mark.long, "how_a_compiled_run_works.md": (needs("compiled"), needs_llvm)}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=MARKS.get(page.name, ()), id=page.name)
        for page in PAGES
        if blocks(page, "python")
    ],
)
def test_python_examples_run(page, tmp_path, monkeypatch):
    """All python blocks of a page: those that begin with the name of a file as modules, together
    with the tests in them, the others one after another in one namespace. Figures, the report's
    stability section and most prices of a design cost seconds and have tests of their own.
    """
    leave_out_what_takes_long(monkeypatch)
    if page.name == "api.md":  # whose runs are as long as they come
        shortened = lambda name, overrides=(): load_scenario(name, [*overrides, "duration=2"])  # noqa: E731
        monkeypatch.setattr("ffsm_drake.load_scenario", shortened)
        if is_there("design"):
            quick = functools.partial(ffsm_drake.design, time_limit=1.0)
            monkeypatch.setattr("ffsm_drake.design", quick)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    found = [(MODULE.match(block), block) for block in blocks(page, "python")]
    modules = dict.fromkeys(name[1] for name, _ in found if name)
    for module in modules:
        assert module not in sys.modules
        text = "\n\n".join(block for name, block in found if name and name[1] == module)
        (tmp_path / f"{module}.py").write_text(text)
    for module in map(importlib.import_module, modules):
        for test in [item for name, item in vars(module).items() if name.startswith("test_")]:
            test()
    namespace = {"__name__": page.stem}
    for name, block in found:
        if not name:
            exec(compile(block, page.name, "exec"), namespace)


@pytest.mark.parametrize(
    ("page", "text"),
    [
        (page.name, text)
        for page in PAGES
        for text in blocks(page, "yaml")
        if "directives:" not in text
    ],
)
def test_scenario_fragments_are_valid(page, text):
    assert scenario_to_dict(scenario_from_yaml(text)) != scenario_to_dict(Scenario()), page


WHOLE = [
    pytest.param(text, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, text in enumerate(blocks(page, "yaml"))
    if re.search(r"^extends:", text, flags=re.MULTILINE)
    and not re.search(r"\bmy_\w+:", text)  # a module of the page
]


@pytest.mark.long  # one searches for a start without contact
@pytest.mark.parametrize("text", WHOLE)
def test_a_scenario_of_a_page_can_begin(text: str) -> None:
    """All that comes before the first sample, such as the plan of an approach, succeeds."""
    make_rollout(make_mission(scenario_from_yaml(text)))


def with_table(page: str) -> str:
    """A page as the site shows it."""
    tables = module_at(DOCS / "_ext/settings_tables.py")
    return tables.with_table(page, (DOCS / f"{page}.md").read_text())


@needs("planning")
def test_lists_of_laws_scenarios_and_plugins_are_made_from_the_package():
    tables = module_at(DOCS / "_ext/settings_tables.py")
    text = tables.with_table("any", "\n".join(["A", *tables.LISTS, "B"]))
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+?) \|", text, re.MULTILINE))
    assert rows.keys() >= {*shipped_names("controller"), *shipped_scenarios(), "planning"}
    assert rows["tvlqr"].startswith("Time-varying linear-quadratic regulator")
    assert "[planning](planning.md) |" in text
    for law in shipped_names("controller"):
        assert f".. automodule:: {find_factory('controller', law).__module__}\n" in text
    assert "<!--" not in text


COUNT = r"\b(?:two|three|four|five|six|seven|eight|nine|ten|\d+) (?:(?:control|other) )?"


@pytest.mark.parametrize("page", ["api", "controllers", "estimators", "law_hooks", "sampled_loop"])
def test_guides_do_not_count_what_can_be_added(page):
    """Neither laws nor hooks; the API names the modules of laws by their list."""
    text = (DOCS / f"{page}.md").read_text()
    assert not re.findall(COUNT + "(?:laws|hooks)", text, re.IGNORECASE)
    assert "automodule:: ffsm_drake.systems.controllers.laws" not in text


def test_links_of_generated_lists_exist():
    for page in filter(None, (plugin.page for plugin in own_plugins().values())):
        assert (DOCS / f"{page}.md").is_file(), page


def test_every_port_is_in_the_reference():
    text = with_table("blocks")
    for ports in BLOCKS.values():
        for name in {**ports.inputs, **ports.optional_inputs, **ports.outputs}:
            assert re.search(rf"^\| .* \| (in|out) `{name}`.* \| .+ \|$", text, re.MULTILINE)


def test_every_scenario_key_is_in_the_reference_with_a_meaning():
    documented, sections, path = set(), set(), ""
    for line in with_table("scenario").splitlines():
        if line.startswith("## "):
            path = "" if line == "## Top level" else line.removeprefix("## ").strip("`") + "."
            sections.add(path.removesuffix("."))  # one that may be null is a key too
        elif line.startswith("| `"):
            key, *_, meaning = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
            assert meaning, f"{path}{key}: write its meaning beside the field in scenario/"
            documented.add(path + key.strip("`"))

    def keys(value, place=""):
        if isinstance(value, dict) and place.removesuffix(".") not in documented:
            for name, item in value.items():
                yield from keys(item, f"{place}{name}.")
        else:
            yield place.removesuffix(".")

    older_drake = {"simulator_config.publish_every_time_step"}
    assert set(keys(scenario_to_dict(Scenario()))) - older_drake <= documented | sections
    assert {
        "disturbance.harmonics.COORDINATE.phase",
        "model.servicer",
        "controllers.tdc.k_p",
    } <= documented


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("payload.truth.inertia", "kg m²"),
        ("controllers.tdc.k_p", "1/s²"),
        ("controllers.aismc.beta", "1/(rad s) or 1/(m s)"),
        ("controllers.tde_aismc.beta", "1/rad or 1/m"),
        ("initial_posture.base_rpy", "rad"),
        ("simulator_config.max_step_size", "s"),
        ("estimator.kind", ""),
    ],
)
def test_units_are_in_the_reference(key, unit):
    text = with_table("scenario")
    place, _, name = key.rpartition(".")
    section = text.split(f"## `{place}`\n")[1].split("\n## ")[0]
    (row,) = [line for line in section.splitlines() if line.startswith(f"| `{name}` ")]
    assert row.split("|")[4].strip() == unit


NAMED = re.compile(r"(?<![\w/.])((?:tests|benchmarks|examples|ffsm_drake)/[\w/.-]+\.(?:py|yaml))")


def test_named_files_exist():
    """A claim names the test that shows it, a guide the file to change; NAME is the reader's."""
    root = DOCS.parent
    pages = [*DOCS.rglob("*.md"), root / "README.md", root / "CONTRIBUTING.md"]
    named = {file for page in pages for file in NAMED.findall(page.read_text(encoding="utf-8"))}
    assert len(named) > 100
    assert not [file for file in named if "NAME" not in file and not (root / file).exists()]


LINKED = re.compile(r"\[`(\w+)`\]\(\.\./(ffsm_drake/[\w/]+\.py)\)")


def links_to_code(page: str) -> list[tuple[str, str]]:
    """Names of a page and the files that they are linked to."""
    return LINKED.findall((DOCS / page).read_text(encoding="utf-8"))


HOW_IT_WORKS = ("how_a_run_works.md", "how_a_compiled_run_works.md")


@pytest.mark.parametrize("page", HOW_IT_WORKS)
def test_linked_names_are_in_the_files_that_they_lead_to(page):
    found = links_to_code(page)
    assert len(found) > 20
    for name, file in found:
        code = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^ *(?:def|class) {name}\b|^{name}\b.* = ", code, re.MULTILINE), name


@pytest.mark.slow
def test_the_steps_of_a_run_are_those_of_simulate_with_a_capture_too(tmp_path, monkeypatch):
    """With a capture a run has several loops."""
    block = blocks(DOCS / "how_a_run_works.md", "python")[0]
    changed = block.replace('"postcapture", ["duration=0.5"]', '"tumbling_capture"')
    assert changed != block
    monkeypatch.chdir(tmp_path)
    namespace = {}
    exec(compile(changed, "how_a_run_works", "exec"), namespace)
    record = simulate(load_scenario("tumbling_capture"), check_stability=False)
    assert namespace["record"].ending.is_settled
    assert np.array_equal(
        namespace["record"].dataset["position"].values, record.dataset["position"].values
    )


@pytest.mark.parametrize("page", HOW_IT_WORKS)
def test_every_name_of_the_package_in_a_run_is_linked(page):
    linked = {name for name, _ in links_to_code(page)}
    for block in blocks(DOCS / page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("ffsm_drake"):
                assert {each.name for each in node.names} <= linked


def test_the_tutorial_is_stored_without_outputs():
    notebook = json.loads((DOCS / "tutorial.ipynb").read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 5
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    # ipykernel's own, in any environment
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"


# the law itself, its fields, gains of the paper's laws, what an engine records of its own law, and
# the step of a factory of forces
NO_HOOKS = {"step", "model", "sample_time", "k_p", "k_s", "logged", "flow"}
READ = re.compile(r"(?:getattr|hasattr|attribute_of)\(\s*(?:[\w.]+\.)?(?:law|factory)\b, \"(\w+)\"")


def hooks_in_the_code() -> set[str]:
    """Members of a law that a user may define: those of its base classes, and what else is read
    from a law if it has it.
    """
    found = {name for kind in (ControlLaw, InjectedDynamics) for name in vars(kind)}
    for file in sorted(Path(ffsm_drake.__file__).parent.rglob("*.py")):
        found |= set(READ.findall(file.read_text(encoding="utf-8")))
    return {name for name in found if not name.startswith("_")} - NO_HOOKS


def test_every_hook_of_a_law_is_in_the_guide():
    """The table of law_hooks.md has the hooks that the code has, and no others."""
    guide = (DOCS / "law_hooks.md").read_text()
    table = guide.split("| hook |")[1].split("\n\n")[0]
    named = {re.match(r"\| `(\w+)", row)[1] for row in table.splitlines()[2:]}
    assert named == hooks_in_the_code()


@pytest.mark.parametrize(
    ("controller", "coordinate"), [("computed_torque", "base_position_x"), ("pd_plus", "joint_2")]
)
def test_the_baselines_sampled_limit(controller, coordinate):
    """sampled_loop.md: near a held posture the largest eigenvalue of H^-1 K_d or H^-1 Hhat K_d must
    stay below 2/L.
    """
    scenario = load_scenario("postcapture")
    posture = json.dumps(scenario_to_dict(scenario)["initial_posture"])
    nominal, true = make_nominal_plant(scenario), make_true_plant(scenario)
    q = make_motion(make_mission(scenario)).evaluate(0.0)[0]
    held = [
        "duration=2",
        "disturbance.amplitude_scale=0",
        f"target_posture={posture}",
        f"controller={controller}",
    ]
    base = 10.0 if controller == "computed_torque" else 0.0
    applied = nominal.calc_mass_matrix(q) if controller == "computed_torque" else np.eye(q.size - 1)

    def radius(k_d):
        gains = np.where(np.array(nominal.coordinates.names) == coordinate, k_d, base)
        return np.linalg.eigvals(
            np.linalg.solve(true.calc_mass_matrix(q), applied * gains)
        ).real.max()

    limit = brentq(lambda k_d: radius(k_d) - 2.0 / scenario.sample_time, 10.0, 1e5)
    late = {}
    for factor in (0.97, 1.03):
        gains = f"controllers.{controller}.k_d={{all: {base}, {coordinate}: {factor * limit}}}"
        stiffness = f"controllers.{controller}.k_p=0"
        record = simulate(load_scenario("postcapture", [*held, gains, stiffness]))
        late[factor] = float(abs(record.dataset["error_rate"][-20:]).max())
    assert late[0.97] < 1e-4 < 1e-2 < late[1.03]


def test_every_public_name_is_in_the_table_of_the_api():
    rows = re.findall(r"^\| [^|`]+ \| (`\w+`(?:, `\w+`)*) \|$", (DOCS / "api.md").read_text(), re.M)
    verbs = {"analyze", "design", "export", "run_campaign", "stability"}
    assert sorted(re.findall(r"\w+", " ".join(rows))) == sorted({*ffsm_drake.__all__, *verbs})


@pytest.mark.parametrize("command", ["frac", "tfrac", "dfrac"])
def test_a_fraction_of_single_characters_is_shown_as_it_is_written(command):
    """As LaTeX does, also if a number follows: its first digit over the second."""
    nodes = pytest.importorskip("docutils.nodes", reason="needs docutils, of the extra docs")
    pytest.importorskip("sphinx", reason="needs Sphinx, of the extra docs")
    convert = module_at(DOCS / "_ext/offline_math.py")._mathml
    for text in (rf"(1 + \{command}12 aL)", rf"\{command} 1 2 x", rf"\{command}{{1}}{{2}} x"):
        shown = re.sub(r"\s", "", convert(nodes.math(text, text), block=True))
        assert "<mfrac><mn>1</mn><mn>2</mn></mfrac>" in re.sub(r"<mfrac[^>]*>", "<mfrac>", shown)
