"""Traced functions as C have the bits of the compiled runs."""

import numpy as np
import pytest
from c_code import call, loaded, needs_c, needs_llvm
from compiled_equations import of_copies, text_of_traced
from tape_cases import CASES

from ffsm_drake.common.choice import repeated
from ffsm_drake.plugins.compiled.compiling import registers
from ffsm_drake.plugins.flight.functions import Function, Precision
from ffsm_drake.plugins.flight.header import static_text
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape, number

pytestmark = needs_llvm
SIZE = 4
HEAD = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\ntypedef double law_real;\n"
HELPERS = static_text("helpers.c").split("static uint32_t")[0]  # larger, smaller
SPECIAL = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e308, -1e-310, 1.0, -2.0, 1e6, 2.5]


def halved(x, times):
    return repeated(
        lambda state, fixed: {"left": state["left"] - 1.0, "x": state["x"] * fixed["half"]},
        {"left": np.float64(times) + 0.0 * x[:1], "x": x},
        {"half": np.array(0.5)},
        most=5,
    )["x"]


def nested(x):
    def step(state, fixed):
        inner = halved(state["x"], 3)
        return {"goes": inner[0] > fixed["least"], "x": inner}

    return repeated(step, {"goes": True, "x": x}, {"least": np.array(2.0)}, most=20)["x"]


ALL = {**CASES, "loops": lambda x: [nested(x)], "places": lambda x: [np.argmin(x)]}


def traced_row(name):
    tape = Tape()
    found = ALL[name](inputs(tape, "x", (SIZE,)))
    flat = [one for each in found for one in np.ravel(np.asarray(each, dtype=object))]
    return tape, [number(one) for one in flat]


def element(array, entry):
    return f"{array}[{entry}]"


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    texts = [HEAD, HELPERS, static_text("angles.c")]
    for name in ALL:
        tape, row = traced_row(name)
        function = Function(name, tape, {"row": row}, Precision(False))
        arguments = "const double *x, double *row"
        texts.append(function.text(arguments, element, element, local=False))
    return loaded(tmp_path_factory.mktemp("c"), "\n".join(texts), "-O2", "-Wno-missing-prototypes")


@needs_c
@pytest.mark.smoke
@pytest.mark.parametrize("name", ALL)
def test_the_bits_are_those_of_compiled_runs(library, name):
    draw = np.random.default_rng(len(name))
    rows = draw.normal(size=(60, SIZE)) * 10.0 ** draw.uniform(-3, 3, size=(60, 1))
    rows[30:] = np.where(draw.random((30, SIZE)) < 0.5, draw.choice(SPECIAL, (30, SIZE)), rows[30:])
    tape, row = traced_row(name)
    text = text_of_traced(registers(), tape, {"x": SIZE}, row)
    expected = of_copies(text, registers(), 1, len(row))(rows)
    for values, wanted in zip(rows, expected, strict=True):
        found = np.zeros(len(row))
        call(getattr(library, name), np.ascontiguousarray(values), found)
        np.testing.assert_array_equal(found, wanted)
        numbers = ~np.isnan(wanted)
        np.testing.assert_array_equal(np.signbit(found[numbers]), np.signbit(wanted[numbers]))


@needs_c
def test_single_precision_is_near(tmp_path):
    texts = [HEAD.replace("double", "float"), HELPERS]
    names = [name for name in ALL if name not in ("rounded", "loops", "places")]
    for name in names:
        tape, row = traced_row(name)
        function = Function(name, tape, {"row": row}, Precision(True))
        texts.append(function.text("const float *x, float *row", element, element, local=False))
    library = loaded(tmp_path, "\n".join(texts), "-O2", "-Wno-missing-prototypes")
    x = np.array([0.3, -0.7, 1.1, 0.2])
    for name in names:
        _, row = traced_row(name)
        found = np.zeros(len(row), np.float32)
        call(getattr(library, name), x.astype(np.float32), found)
        with np.errstate(all="ignore"):
            exact = np.concatenate([np.ravel(each) for each in ALL[name](x)]).astype(float)
        np.testing.assert_allclose(found, exact, rtol=2e-5, atol=1e-6, err_msg=name)
