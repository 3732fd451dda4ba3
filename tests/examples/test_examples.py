"""Every example runs with a tiny horizon and only the public API."""

import ast
import json
import re
import runpy
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).resolve().parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
# The package itself, and subpackages whose `__all__` is public.
PUBLIC = {"friction", "fuzzy", "fitting", "papers", "report", "signals", "simulation"}

# Text required in the last lines of each output, so that a silent failure is detected.
SAID = {
    "export_to_c": "selftest",
    "feedforward": "compensated: the true one",
    "fit_a_recording": "best: ",
    "fuzzy_rules": "in % of range",
    "many_fits_on_dask": "fitted on 2 workers",
    "motor_bench": "true 0.12",
    "neuro_fuzzy": "THEN C_p = ",
    "own_law": "true 0.0004",
    "own_rig": "fitted B, C:",
    "rtip_table_4": "NLFM, printed",
}


def compensation_reduces_the_error(printed: str) -> bool:
    """A better friction model has a smaller tracking error, and the true one the smallest."""
    errors = [float(x) for x in re.findall(r"tracking error +([\d.]+) mrad", printed)]
    none, *learnt, true = errors
    return errors == sorted(errors, reverse=True) and max(learnt) < 0.1 * none and true > 0


def five_coefficients_are_best(printed: str) -> bool:
    """The RTIP paper's claim is true of either recording, for the sum over the joints."""
    rows = re.findall(r"^(\w+), (\w+) +([\d.]+) +([\d.]+) +([\d.]+)$", printed, re.MULTILINE)
    total = {(model, kind): sum(map(float, joints)) for model, kind, *joints in rows}
    kinds = ("fitted", "test", "printed")
    return all(total["NLFM", k] < min(total["NCFM", k], total["LFM", k]) for k in kinds)


# Further conditions on the printed numbers.
LAWS = {
    "feedforward": compensation_reduces_the_error,
    "rtip_table_4": five_coefficients_are_best,
}

# Packages that some need in addition.
NEEDS = {"many_fits_on_dask": ("dask", "distributed", "joblib")}


def test_every_example_is_known() -> None:
    assert {path.stem for path in EXAMPLES} == set(SAID)


# A cluster's processes load the whole package first; networks train for seconds.
SLOW = {"feedforward", "many_fits_on_dask", "neuro_fuzzy", "rtip_table_4"}
RUNS = [pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in SLOW))
        for path in EXAMPLES]  # fmt: skip


@pytest.mark.parametrize("path", RUNS)
def test_examples_run_quickly(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for library in NEEDS.get(path.stem, ()):
        pytest.importorskip(library, reason="`pip install nfriction[dask]` to run this")
    torch.set_num_threads(1)
    main = runpy.run_path(str(path))["main"]
    assert main(["--quick", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out.replace("self-test", "selftest")
    assert SAID[path.stem] in printed
    assert "nan" not in printed
    assert path.stem not in LAWS or LAWS[path.stem](printed)
    assert list((tmp_path / "out").rglob("*.*"))


NOTEBOOKS = sorted((FOLDER / "notebooks").glob("*.ipynb"))


@pytest.mark.filterwarnings("ignore:.*looks like degrees")
@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=[pytest.mark.slow] * (p.stem == "free_swing")) for p in NOTEBOOKS],
    ids=lambda path: path.stem,
)
def test_notebooks_run_from_top_to_bottom(path: Path) -> None:
    torch.set_num_threads(1)
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert sum(text.count("seconds = 10.0") for text in code) == 1
    assert not any(cell.get("outputs") for cell in cells)
    known: dict[str, object] = {"__name__": "__main__"}
    for text in code:
        exec(compile(text.replace("seconds = 10.0", "seconds = 1.5"), path.name, "exec"), known)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short_and_use_only_the_public_api(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 75
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nfriction."):
            assert (node.module or "").split(".")[1] in PUBLIC
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_") or node.attr.startswith("__")
