"""Exported C: strict C89 and C++, equal to its model, and within the contract at the edges."""

import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.codegen import UnsupportedOperation
from nfriction.export.c_dialect import comment
from nfriction.export.c_file import c, c_contract, c_runner
from nfriction.export.contract import ExportError, compare, draw, verify
from nfriction.export.controller import NOT_FINITE, OUTSIDE, SATURATED, controller_of
from nfriction.friction import model_by_name, model_names
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.memory import Gear
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo
from nfriction.plant import LinearAxis, Rotor, rigs
from tests.export.artefacts import Rising
from tests.friction.samples import randomise

STUBS = Path(__file__).parent / "stubs"
GCC, GXX = shutil.which("gcc"), shutil.which("g++")
pytestmark = pytest.mark.skipif(not (GCC and GXX), reason="needs gcc and g++")

STRICT = ["-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]
C89 = ["gcc", "-std=c89", "-pedantic", *STRICT]
CXX = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror"]
# Relative to full scale. A double rounds to 1e-16, and the torque sums some dozens of terms.
TOLERANCE = {"float64": 1e-14, "float32": 5e-7}
# Constants of the size of the papers' rigs.
INITIAL = {
    "viscous": [0.02],
    "coulomb": [0.05],
    "coulomb_viscous": [0.05, 0.02],
    "linear": [0.02, 0.05],
    "nonlinear": [0.005, 0.05, 0.02, 0.02, 2.0],
    "stribeck": [0.05, 0.02, 0.02, 0.3, 1.5],
}
INFO = ModelInfo(
    joint_names=("shoulder", "elbow", "wrist"),
    sample_time=1e-3,
    input_ranges={"qd": [[-8.0, 7.1], [-6.0, 6.0], [-9.3, 9.0]], "qdd": [[-60.0, 50.1]] * 3},
)


def random_model(name: str, joints: int = 3, seed: int = 0) -> FrictionModel:
    """A named model with every parameter changed from its initial value."""
    random = torch.Generator().manual_seed(seed)
    kind = model_by_name(name)
    initial = INITIAL[kind(1).law.name]
    factors = 1.0 + 0.3 * torch.rand(joints, len(initial), generator=random, dtype=torch.float64)
    model = kind(joints, factors * torch.tensor(initial, dtype=torch.float64))
    with torch.no_grad():
        for p in model.parameters():
            p.add_(0.1 * torch.randn(p.shape, generator=random, dtype=p.dtype))
    return model


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Export the named models, each once per dtype, and return model, controller and folder."""

    @cache
    def export(name: str, dtype: str, **options):
        folder = tmp_path_factory.mktemp(f"{name}_{dtype}")
        model = random_model(name)
        c(model, folder, INFO, dtype=dtype, **options)
        controller = controller_of(model, INFO, **options)
        return model, controller, folder

    return export


def build(command, folder: Path) -> None:
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert not result.returncode, result.stderr


def self_test(
    folder: Path, *flags: str, source: str = "nfriction.c", name: str = "nfriction"
) -> None:
    build(["gcc", *flags, f"{name}_selftest.c", source, "-o", "selftest", "-lm"], folder)
    result = subprocess.run([folder / "selftest"], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-500:]
    assert "0 wrong" in result.stdout


def points(controller, dtype: str, count: int):
    inputs = draw(controller, count, seed=3)
    return tuple(x.float().double() for x in inputs) if dtype == "float32" else inputs


cases = pytest.mark.parametrize("dtype", ["float64", "float32"])
names = pytest.mark.parametrize("name", model_names())
few = pytest.mark.parametrize("name", ["Stribeck", "ALFM", "NFLFM"])  # one of each kind


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@names
def test_is_strict_c89_and_passes_its_own_test(exported, name, dtype):
    _, _, folder = exported(name, dtype)
    build([*C89, "-O1", "-c", "nfriction.c", "-o", "n.o"], folder)
    imports = subprocess.run(["nm", "-u", "n.o"], cwd=folder, capture_output=True, text=True)
    single = "f" if dtype == "float32" else ""
    allowed = {f + single for f in ("exp", "tanh", "atan", "log", "sqrt")}
    assert set(re.findall(r"U ([a-z]\w*)", imports.stdout)) <= allowed  # not the compiler's own
    data = subprocess.run(["size", "-A", "n.o"], cwd=folder, capture_output=True, text=True).stdout
    sizes = dict(re.findall(r"^(\.data|\.bss)\s+(\d+)", data, re.M))
    assert sizes == {".data": "0", ".bss": "0"}, "no globals that change"
    self_test(folder, source="n.o")
    assert len(c_contract(folder / "nfriction.c").outputs["status"]) >= 200


@cases
@few
def test_is_valid_cpp(exported, name, dtype):
    _, _, folder = exported(name, dtype)
    build([*CXX, "-Wconversion", "-fsyntax-only", "-x", "c++", "nfriction.c"], folder)


@cases
@few
def test_equals_its_model_within_and_beyond_the_range(exported, name, dtype):
    _, controller, folder = exported(name, dtype)
    # Models with a hidden state are stepped one sample at a time in torch.
    inputs = points(controller, dtype, 500 if controller.state_size else 5000)
    run = c_runner(folder / "nfriction.c")
    parity = compare(controller.run(*inputs), run(*inputs), TOLERANCE[dtype])
    assert parity.passed, parity
    assert verify(run, c_contract(folder / "nfriction.c")).passed


@pytest.mark.slow
@cases
@names
def test_is_valid_cpp_and_passes_its_own_test_under_fast_math(exported, name, dtype):
    _, _, folder = exported(name, dtype)
    build([*CXX, "-O2", "-c", "-x", "c++", "nfriction.c", "-o", "cpp.o"], folder)
    self_test(folder, "-O3", "-ffast-math")


@pytest.mark.slow
@cases
@names
def test_equals_its_model_at_200000_points(exported, name, dtype):
    _, controller, folder = exported(name, dtype)
    inputs = points(controller, dtype, 20_000 if controller.state_size else 200_000)
    expected = controller.run(*inputs)
    for flags in (("-std=c89", "-O2"), ("-O3", "-ffast-math")):
        found = c_runner(folder / "nfriction.c", flags)(*inputs)
        parity = compare(expected, found, TOLERANCE[dtype])
        assert parity.passed, (flags, parity)


def test_the_self_test_can_fail(exported, tmp_path):
    shutil.copytree(exported("LFM", "float64")[2], tmp_path / "c")
    source = tmp_path / "c" / "nfriction.c"
    number = re.search(r"\d\.\d{9,}", source.read_text()).group()
    source.write_text(source.read_text().replace(number, f"{float(number) * (1 + 1e-9)!r}"))
    build(["gcc", "nfriction_selftest.c", "nfriction.c", "-o", "selftest", "-lm"], source.parent)
    assert subprocess.run([tmp_path / "c" / "selftest"], capture_output=True).returncode == 1


@cases
@pytest.mark.parametrize("flags", [("-O0",), ("-O3", "-ffast-math")])
@pytest.mark.parametrize("name", ["NFLFM", "ALFM"])
def test_non_finite_inputs_affect_only_their_joint(exported, name, dtype, flags):
    _, controller, folder = exported(name, dtype)
    run = c_runner(folder / "nfriction.c", flags)
    sound = [x[:1] for x in points(controller, dtype, 1)]
    clean = run(*sound)
    for which in range(3):
        for bad in (np.nan, np.inf, -np.inf):
            given = [x.clone() for x in sound]
            given[which][0, 1] = bad
            tau, coefficients, status = run(*given)
            assert np.isnan(tau[0, 1])
            assert np.isnan(coefficients[0, 1]).all()
            assert status[0, 1] == NOT_FINITE
            for joint in (0, 2):
                assert tau[0, joint] == clean[0][0, joint]
                assert status[0, joint] == clean[2][0, joint]


def test_fast_math_does_not_affect_this_process(exported):
    _, controller, folder = exported("LFM", "float64")
    c_runner(folder / "nfriction.c", ("-O3", "-ffast-math"))(*points(controller, "float64", 5))
    tiny = np.full(3, 1e-310)
    assert (tiny * 0.5 > 0).all()


@cases
def test_overflowing_torque_is_reported_as_not_finite(exported, dtype):
    _, _, folder = exported("LFM", dtype)
    huge = 1e38 if dtype == "float32" else 1e308
    x = np.full((1, 3), huge)
    tau, _, status = c_runner(folder / "nfriction.c")(x, 0 * x, x)
    stays = np.isfinite(tau) == (status & NOT_FINITE == 0)
    assert stays.all()


def test_status_reports_clamping_and_saturation(exported):
    _, controller, folder = exported("NFLFM", "float64", torque_limit=0.05)
    inputs = draw(controller, 2000, seed=1)
    tau, _, status = c_runner(folder / "nfriction.c")(*inputs)
    np.testing.assert_array_equal(status, controller.run(*inputs)[2])
    assert np.abs(tau).max() == 0.05
    for bit in (OUTSIDE, SATURATED):
        assert 0 < (status & bit > 0).mean() < 1
    self_test(folder)


@cases
@pytest.mark.parametrize("name", [pytest.param("LFM", marks=pytest.mark.slow), "ALFM"])
def test_the_filter_runs_inside(exported, name, dtype):
    _, controller, folder = exported(name, dtype, with_filter=True)
    build([*C89, "-c", "nfriction.c", "-o", "n.o"], folder)
    header = (folder / "nfriction.h").read_text()
    assert " * Filter: second-order low-pass, cut-off 20 Hz, damping " in header
    build([*CXX, "-fsyntax-only", "-x", "c++", "nfriction.c"], folder)
    self_test(folder, "-O2")
    self_test(folder, "-O3", "-ffast-math")
    if dtype == "float64":
        inputs = draw(controller, 300)
        found = c_runner(folder / "nfriction.c")(*inputs)
        # Two differences over a millisecond each amplify round-off a thousandfold.
        parity = compare(controller.run(*inputs), found, 1e-10)
        assert parity.passed, parity


def test_export_is_deterministic(exported, tmp_path):
    for name in ("NFNLFM", "ANLFM"):
        _, _, folder = exported(name, "float32")
        for path in c(random_model(name), tmp_path / name, INFO, dtype="float32"):
            assert path.read_bytes() == (folder / path.name).read_bytes(), path.name


@given(st.text(max_size=40))
def test_foreign_text_cannot_leave_its_comment(text):
    inside = comment(text)
    assert "*/" not in f" * {inside}\n */"[:-3]
    assert inside.isascii()
    assert not re.search(r"[\n\r\\]|\?\?", inside)


def test_hostile_names_do_not_become_code(tmp_path):
    names = ("*/ int evil(void) { return 1; } /*", "a\\\nint evil;", "??/\n#error")
    info = ModelInfo(joint_names=names, training_data={"*/ int evil;": "*/"})
    c(random_model("LFM"), tmp_path, info)
    build([*C89, "-c", "nfriction.c", "-o", "n.o"], tmp_path)
    symbols = subprocess.run(["nm", "n.o"], cwd=tmp_path, capture_output=True, text=True).stdout
    assert "evil" not in symbols
    for bad in ("int", "a b", "1a", "x;y", "", "a" * 40, "ß"):
        with pytest.raises(ValueError, match="name"):
            c(random_model("LFM"), tmp_path, name=bad)


def test_two_controllers_live_in_one_program(tmp_path):
    """Each equals its separate build, with memory and filter, in one folder and with either
    header."""
    names = ("ALFM", "NFLFM", "NLFM")
    for name in names:
        c(random_model(name), tmp_path, INFO, name=name.lower(), with_filter=name == "ALFM")
        self_test(tmp_path, source=f"{name.lower()}.c", name=name.lower())
    for suffix, command in (("h", C89), ("hpp", CXX)):
        main = tmp_path / ("main.c" if suffix == "h" else "main.cpp")
        main.write_text(
            "".join(f'#include "{name.lower()}.{suffix}"\n' for name in names)
            + "#include <stdio.h>\nint main(void) {\n"
            "    double x[3] = {1, 1, 1}, tau[3], c[15];\n    int s[3];\n    alfm_state memory;\n"
            "    alfm_init(&memory, x, x);\n    alfm_step(&memory, x, x, x, tau, c, s);\n"
            '    printf("%.17g ", tau[2]);\n'
            '    nflfm_step(x, x, x, tau, c, s);\n    printf("%.17g ", tau[2]);\n'
            '    nlfm_step(x, x, x, tau, c, s);\n    printf("%.17g", tau[2]);\n'
            "    return 0;\n}\n"
        )
        for name in names:
            build([*C89, "-c", f"{name.lower()}.c"], tmp_path)
        objects = [f"{name.lower()}.o" for name in names]
        build([*command, main.name, *objects, "-o", "all", "-lm"], tmp_path)
        output = subprocess.run(
            [tmp_path / "all"], capture_output=True, text=True, check=True
        ).stdout
        one = torch.ones(3, dtype=torch.float64)
        expected = [random_model(name)(one, one, one)[2].item() for name in names]
        np.testing.assert_allclose([float(x) for x in output.split()], expected, rtol=1e-13)


def test_the_sketch_of_a_gear_names_the_torque_to_read(tmp_path):
    c(Gear(2), tmp_path, ModelInfo(sample_time=1e-3))
    head = (tmp_path / "nfriction.ino").read_text().partition("extern")[0]
    assert "write `read_position`, `read_torque` and `write_torque` for your board" in head
    build([*CXX, f"-I{STUBS}", "-fsyntax-only", "-x", "c++", "nfriction.ino"], tmp_path)


@pytest.mark.parametrize("with_filter", [False, True])
def test_sketch_starts_at_rest_from_any_position(tmp_path, with_filter):
    """Positions before the first call are half a turn, not zero."""
    c(random_model("LFM"), tmp_path, INFO, with_filter=with_filter)
    (tmp_path / "main.cpp").write_text(
        '#include "nfriction.ino"\n#include <cstdio>\n'
        "static unsigned long now;\nunsigned long micros() { return now; }\n"
        "int analogRead(int) { return 512; }\n"
        'void analogWrite(int, int value) { std::printf("%d ", value); }\n'
        "int main() {\n    setup();\n    loop();\n    now += PERIOD;\n    loop();\n}\n"
    )
    build(["gcc", "-c", "nfriction.c"], tmp_path)
    build([*CXX, f"-I{STUBS}", "main.cpp", "nfriction.o", "-o", "sketch"], tmp_path)
    output = subprocess.run(
        [tmp_path / "sketch"], capture_output=True, text=True, check=True
    ).stdout
    assert output.split() == ["128"] * 6


@pytest.mark.parametrize(("law", "period"), [("LFM", "INHERITED_SAMPLE_TIME"), ("LuGre", "0.004")])
def test_the_s_function_of_a_hidden_state_has_its_sample_time(tmp_path, law, period):
    c(model_by_name(law)(2), tmp_path, ModelInfo(sample_time=0.004))
    assert f"ssSetSampleTime(S, 0, {period})" in (tmp_path / "nfriction_sfun.c").read_text()


@cases
@pytest.mark.parametrize("with_filter", [False, True])
@pytest.mark.parametrize("name", ["NLFM", "ALFM"])
def test_skeletons_and_wrapper_compile(exported, name, dtype, with_filter):
    _, _, folder = exported(name, dtype, **({"with_filter": True} if with_filter else {}))
    build([*C89[:-1], "-Wno-conversion", "-Werror", f"-I{STUBS}", "-c", "nfriction_sfun.c",
           "-o", "s.o"], folder)  # fmt: skip
    build([*CXX, f"-I{STUBS}", "-fsyntax-only", "-x", "c++", "nfriction.ino"], folder)
    build(
        [
            *CXX,
            "-Wconversion",
            "-fsyntax-only",
            "-x",
            "c++",
            "nfriction.hpp",
            "-Wno-pragma-once-outside-header",
        ],
        folder,
    )


def test_simulink_and_cpp_give_the_same_torque_as_c(exported):
    _, _, folder = exported("ALFM", "float64")
    (folder / "main.cpp").write_text(
        '#include <cstdio>\n#include "nfriction.hpp"\n#include "simstruc.h"\n'
        'extern "C" { void stub_sizes(SimStruct *); void stub_outputs(SimStruct *); }\n'
        "int main() {\n    static SimStruct S;\n"
        "    nfriction::Friction friction;\n    stub_sizes(&S);\n"
        "    double worst = 0;\n    for (int k = 0; k < 500; ++k) {\n"
        "        nfriction::Joints qd{}, qdd{}, load{};\n"
        "        for (unsigned j = 0; j < 3; ++j) {\n"
        "            S.in[0][j] = qd[j] = 0.01 * k - j;\n"
        "            S.in[1][j] = qdd[j] = 300.0 / (1 + k) - 2.0 * j;\n"
        "            S.in[2][j] = load[j] = 1;\n        }\n        stub_outputs(&S);\n"
        "        const nfriction::Output out = friction.step(qd, qdd, load);\n"
        "        for (unsigned j = 0; j < 3; ++j) {\n"
        "            const double d = S.out[0][j] - out.tau[j];\n"
        "            worst = d > worst ? d : -d > worst ? -d : worst;\n        }\n    }\n"
        '    std::printf("%g %.17g\\n", worst, S.out[0][1]);\n    return worst > 0;\n}\n'
    )
    build(["gcc", f"-I{STUBS}", "-c", "nfriction_sfun.c", "nfriction.c"], folder)
    build(
        ["g++", f"-I{STUBS}", "main.cpp", "nfriction_sfun.o", "nfriction.o", "-o", "both"], folder
    )
    result = subprocess.run([folder / "both"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
    assert float(result.stdout.split()[1]) != 0.0


def drag(qd, load, coefficients, v_smooth):
    return coefficients.select(-1, 0) * qd * qd.abs() + 0.1 * coefficients.sum(-1) * load


DRAG = Law("drag", (Coefficient("D", "N m s^2/rad^2"), Coefficient("E", "N m")), drag)


class Sums(Constant):
    """A user-defined schedule that couples the joints, so that no two are equal."""

    def forward(self, qd, qdd):
        spread = torch.cos(torch.cumsum(qd, -1)).unsqueeze(-1)
        return super().forward(qd, qdd) * (2.0 + spread + 1e-3 * qdd.sum(-1)[..., None, None])


@cases
@pytest.mark.parametrize("schedule", [Constant, Sums])
def test_user_defined_law_and_schedule_are_exported(tmp_path, schedule, dtype):
    model = FrictionModel(DRAG, schedule(DRAG, 3, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]))
    c(model, tmp_path, INFO, dtype=dtype)
    controller = controller_of(model, INFO)
    inputs = points(controller, dtype, 2000)
    run = c_runner(tmp_path / "nfriction.c")
    parity = compare(controller.run(*inputs), run(*inputs), TOLERANCE[dtype])
    assert parity.passed, parity


class Fading(Constant):
    """A hidden state of the past motion that depends on more than the last sample."""

    state_size = 2

    def initial_state(self, qd, qdd):
        return torch.stack([qd, qdd], -1)

    def advance(self, qd, qdd, state):
        return 0.9 * state + 0.1 * torch.stack([qd, qdd], -1)

    def coefficients_from(self, qd, qdd, state):
        centres = torch.linspace(-8.0, 8.0, 12, dtype=qd.dtype)
        near = torch.exp(-0.1 * (state[..., :1] - centres).clamp(-20.0, 20.0).square()).sum(-1)
        return super().forward(qd, qdd) * (1.0 + near + torch.tanh(0.1 * qdd)).unsqueeze(-1)

    def forward(self, qd, qdd):
        return self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))


@cases
@pytest.mark.parametrize("flags", [("-O3",), ("-O3", "-ffast-math")])
def test_user_defined_schedule_with_memory_is_exported(tmp_path, dtype, flags):
    """If only the load is not finite, the hidden state still advances."""
    model = FrictionModel(DRAG, Fading(DRAG, 3, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]))
    c(model, tmp_path, INFO, dtype=dtype)
    build([*C89, "-c", "nfriction.c", "-o", "n.o"], tmp_path)
    controller = controller_of(model, INFO)
    inputs = [x.clone() for x in points(controller, dtype, 300)]
    for which, joint in ((0, 0), (1, 1), (2, 2)):
        inputs[which][20 + which :: 40, joint] = (torch.nan, torch.inf, -torch.inf)[which]
    found = c_runner(tmp_path / "nfriction.c", flags)(*inputs)
    parity = compare(controller.run(*inputs), found, TOLERANCE[dtype])
    assert parity.passed, parity
    self_test(tmp_path, *flags)


@cases
@pytest.mark.parametrize("schedule", [Rising, Fading])
def test_schedule_without_a_range_is_clamped_in_c_too(tmp_path, schedule, dtype):
    """Also with a name that begins like those in the templates."""

    class Unbounded(schedule):
        handles_range = False

    model = FrictionModel(DRAG, Unbounded(DRAG, 3, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]))
    c(model, tmp_path, INFO, dtype=dtype, name="nf_max")
    build([*C89, "-c", "nf_max.c", "-o", "n.o"], tmp_path)
    controller = controller_of(model, INFO)
    assert controller.clamps
    inputs = points(controller, dtype, 500)
    found = c_runner(tmp_path / "nf_max.c")(*inputs)
    parity = compare(controller.run(*inputs), found, TOLERANCE[dtype])
    assert parity.passed, parity
    assert verify(c_runner(tmp_path / "nf_max.c"), c_contract(tmp_path / "nf_max.c")).passed


@pytest.mark.parametrize("terms", [(3, 5), (6, 2)])
def test_inputs_may_differ_in_their_number_of_sets(tmp_path, terms):
    model = model_by_name("NFLFM")(2, INITIAL["linear"], terms=terms)
    randomise(model, 0.2)
    c(model, tmp_path)
    inputs = points(controller_of(model), "float64", 1000)
    parity = compare(controller_of(model).run(*inputs), c_runner(tmp_path / "nfriction.c")(*inputs),
                     TOLERANCE["float64"])  # fmt: skip
    assert parity.passed, parity


def test_sets_so_narrow_that_all_underflow_are_exported(tmp_path):
    model = random_model("NFLFM")
    with torch.no_grad():
        model.schedule.network.anfis.partition.log_widths.sub_(2.7)
    c(model, tmp_path, INFO)
    assert verify(c_runner(tmp_path / "nfriction.c"), c_contract(tmp_path / "nfriction.c")).passed


def test_a_law_may_differ_by_joint(tmp_path):
    """A law with separate constants for each joint is written out for all joints."""
    factors = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)

    def own(qd, load, coefficients, v_smooth):
        return coefficients.select(-1, 0) * qd * factors[: qd.shape[-1]]

    law = Law("own", (Coefficient("A", "N m s/rad"),), own)
    model = FrictionModel(law, Constant(law, 3, [[0.1], [0.2], [0.3]]))
    c(model, tmp_path, INFO)
    inputs = points(controller_of(model, INFO), "float64", 100)
    found = c_runner(tmp_path / "nfriction.c")(*inputs)
    assert compare(controller_of(model, INFO).run(*inputs), found, TOLERANCE["float64"]).passed


def test_an_operation_without_c_form_is_named(tmp_path):
    def bessel(qd, load, coefficients, v_smooth):
        return torch.special.bessel_j0(qd) * coefficients.select(-1, 0)

    law = Law("bessel", (Coefficient("A", "N m"),), bessel)
    with pytest.raises(ExportError, match="bessel_j0") as caught:
        c(FrictionModel(law, Constant(law, 2)), tmp_path)
    assert isinstance(caught.value.__cause__, UnsupportedOperation)
    assert not list(tmp_path.iterdir())


ARM = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]
START = """
extern void _start(void);
void reset(void)
{
    *(volatile unsigned *)0xE000ED88 |= 0xFu << 20; /* the FPU is off after reset */
    __asm volatile("dsb\\n isb");
    _start();
}
__attribute__((section(".vectors"), used)) static const void *const vectors[2] = {
    (const void *)0x20300000, (const void *)reset};
"""
PLACES = ["-Wl,--section-start=.vectors=0", "-Wl,-Ttext=0x10000", "-Wl,-Tdata=0x20000000"]


@pytest.mark.skipif(
    not (shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")),
    reason="needs arm-none-eabi-gcc with newlib, and qemu-system-arm",
)
@pytest.mark.parametrize(("name", "flags"), [("NFLFM", ("-Os",)), ("ALFM", ("-O3", "-ffast-math"))])
def test_self_test_passes_on_a_cortex_m4(exported, name, flags):
    _, _, folder = exported(name, "float32")
    (folder / "start.c").write_text(START)
    build(["arm-none-eabi-gcc", *flags, *ARM, "--specs=rdimon.specs", *PLACES, "start.c",
           "nfriction_selftest.c", "nfriction.c", "-o", "m4.elf", "-lm"], folder)  # fmt: skip
    machine = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-monitor", "none",
               "-serial", "none", "-semihosting-config", "enable=on,target=native"]  # fmt: skip
    result = subprocess.run(
        [*machine, "-kernel", folder / "m4.elf"], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stdout
    assert "0 wrong" in result.stdout + result.stderr


@pytest.mark.skipif(not shutil.which("arm-none-eabi-gcc"), reason="needs arm-none-eabi-gcc")
def test_one_joint_fits_a_small_flash(tmp_path):
    info = ModelInfo(input_ranges={"qd": [[-8.0, 7.1]], "qdd": [[-60.0, 50.1]]})
    c(random_model("NFLFM", joints=1), tmp_path, info, dtype="float32")
    build(["arm-none-eabi-gcc", "-std=c89", "-Os", *ARM, "-c", "nfriction.c", "-o", "m4.o"],
          tmp_path)  # fmt: skip
    sizes = subprocess.run(
        ["arm-none-eabi-size", tmp_path / "m4.o"], capture_output=True, text=True
    )
    text, data, bss = map(int, sizes.stdout.splitlines()[1].split()[:3])
    assert text <= 2400
    assert data == bss == 0


@pytest.mark.skipif(
    not (shutil.which("powerpc-linux-gnu-gcc") and shutil.which("qemu-ppc")),
    reason="needs powerpc-linux-gnu-gcc and qemu-ppc",
)
@cases
@pytest.mark.parametrize(("name", "flags"), [("NFLFM", ("-O1",)), ("ALFM", ("-O3", "-ffast-math"))])
def test_self_test_passes_on_a_big_endian_powerpc(exported, name, dtype, flags):
    _, _, folder = exported(name, dtype)
    build(["powerpc-linux-gnu-gcc", *flags, "-static", "nfriction_selftest.c", "nfriction.c",
           "-o", "ppc", "-lm"], folder)  # fmt: skip
    result = subprocess.run(
        ["qemu-ppc", folder / "ppc"], capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(
    "plant",
    [rigs.multiarm_triple(), rigs.tlrip("free"), Rotor(0.02)],
    ids=["chain", "arm", "rotor"],
)
def test_load_function_of_the_export_equals_that_of_the_plant(plant, dtype, tmp_path):
    joints = plant.joints
    info = ModelInfo(rig=plant.to_dict(), joint_names=plant.joint_names)
    model = random_model("LFM", joints)
    c(model, tmp_path, info, dtype=dtype)
    q, qd = torch.randn(2, 200, joints, generator=torch.Generator().manual_seed(1)).double()
    rows = torch.cat([q, qd], -1).tolist()
    numbers = ",\n".join(", ".join(map(repr, row)) for row in rows)
    (tmp_path / "main.cpp").write_text(
        '#include <cstdio>\n#include "nfriction.hpp"\n'
        f"static const double rows[200][{2 * joints}] = {{{numbers}}};\n"
        "int main() {\n    for (int k = 0; k < 200; ++k) {\n"
        "        nfriction::Joints q{}, qd{};\n"
        f"        for (unsigned j = 0; j < {joints}; ++j) {{\n"
        "            q[j] = static_cast<nfriction::Real>(rows[k][j]);\n"
        f"            qd[j] = static_cast<nfriction::Real>(rows[k][{joints} + j]);\n        }}\n"
        "        for (double n : nfriction::Friction::load(q, qd))\n"
        '            std::printf("%.17g ", n);\n    }\n    return 0;\n}\n'
    )
    build([*C89, "-c", "nfriction.c"], tmp_path)
    build([*CXX, "-Wno-missing-braces", "main.cpp", "nfriction.o", "-o", "load"], tmp_path)
    output = subprocess.run([tmp_path / "load"], capture_output=True, text=True, check=True).stdout
    found = np.array([float(x) for x in output.split()]).reshape(-1, joints)
    tolerance = 1e-14 if dtype == "float64" else 2e-6
    expected = plant.load(q, qd).numpy()
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
    build([*CXX, f"-I{STUBS}", "-fsyntax-only", "-x", "c++", "nfriction.ino"], tmp_path)
    build([*C89[:-1], "-Wno-conversion", "-Werror", f"-I{STUBS}", "-c", "nfriction_sfun.c",
           "-o", "s.o"], tmp_path)  # fmt: skip
    c(random_model("CVFM", joints), tmp_path / "even", info)
    assert "HAS_LOAD 0" in (tmp_path / "even" / "nfriction.h").read_text()


def test_comments_name_continuous_and_linear_positions(tmp_path):
    texts = {}
    for unit, plant in (("rad", rigs.multiarm_double()), ("m", LinearAxis(2.0))):
        info = ModelInfo(unit=unit, rig=plant.to_dict(), sample_time=1e-3)
        c(random_model("LFM", plant.joints), tmp_path, info, with_filter=True)
        texts[unit] = [(tmp_path / f"nfriction.{x}").read_text() for x in ("h", "ino", "hpp")]
        assert "continuous: unwrap" in texts[unit][0]
        assert "It must be continuous" in texts[unit][1]
    assert "the first angle from" in texts["rad"][0]
    assert not any(word in text for text in texts["m"] for word in ("angle", "upright"))


def test_header_contains_the_fitted_offsets_and_losses_of_the_drives(tmp_path):
    plant = rigs.multiarm_double()
    offset, loss = torch.tensor([[0.0, -0.015], [0.05, 0.0]], dtype=torch.float64)
    fitted = plant.replace(torque_offset=offset, gear_loss=loss)
    for name, rig in (("with", fitted), ("without", plant)):
        c(random_model("CVFM", 2), tmp_path, ModelInfo(rig=rig.to_dict()), name=name)
    header = (tmp_path / "with.h").read_text()
    assert " *     0 -0.015 [N m]\n" in header
    assert "the gears lose in the fitted plant, which oppose qd:\n *     0.05 0 [-]\n" in header
    assert "Not in tau" not in (tmp_path / "without.h").read_text()
