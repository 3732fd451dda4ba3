"""The command line before any computation: help, errors, names, and start-up time."""

import argparse
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nfriction import cli, rigs
from nfriction.cli import demo, inputs
from nfriction.cli.console import FirstOfItsKind, one_line
from nfriction.friction.models import NCFM
from nfriction.io.model_file import save
from nfriction.papers import twin
from nfriction.papers.twin import family
from nfriction.plant import robot_file
from nfriction.version import __version__


def commands() -> dict[str, argparse.ArgumentParser]:
    (found,) = (a for a in cli.make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return found.choices


def example(parser: argparse.ArgumentParser) -> list[str]:
    """The arguments of the command at the end of a help text."""
    block = parser.format_help().partition("\nexample:\n")[2].partition("\n\n")[0]
    return block.replace("\\\n", " ").split()


def test_a_console_shows_each_kind_of_message_once() -> None:
    new = FirstOfItsKind()
    given = [
        ("%d rollout(s) diverged", 3), ("%d rollout(s) diverged", 4), ("%s failed: no data", "LFM"),
        ("%s failed: no data", "NCFM"), ("%s", "first"), ("%s", "second"),
    ]  # fmt: skip
    records = [logging.makeLogRecord({"msg": msg, "args": (arg,)}) for msg, arg in given]
    shown = [new.filter(record) for record in records]
    assert shown == [True, False, True, True, True, True]


def test_model_names_are_those_of_the_library() -> None:
    assert rigs.names() == list(inputs.RIGS)
    assert inputs.models(inputs.DEFAULT_MODELS) == ["NCFM", "LFM", "NLFM", "Stribeck", "NFLFM"]
    assert (".json", ".toml", *robot_file.ENDINGS) == inputs.RIG_FILES
    assert (demo.DURATION, demo.TWIN_DURATION) == (twin.QUICK_DURATION, family.DURATION)
    assert demo.TRUTHS == twin.TRUTHS


@pytest.mark.parametrize("name", list(commands()))
def test_help_explains_every_option_and_ends_with_an_example(name: str) -> None:
    parser = commands()[name]
    for action in parser._actions:
        assert action.help, f"{name} {action.dest} says nothing"
    assert example(parser)[:2] == ["nfriction", name]
    for action in parser._actions:
        if action.option_strings and action.default not in (None, False, [], "==SUPPRESS=="):
            help_text = parser._get_formatter()._expand_help(action)
            in_words = "(default: " in action.help
            assert help_text.count("(default: ") == 1, (
                f"{name} {action.dest} gives its default twice"
            )
            assert in_words or f"(default: {action.default})" in help_text


@pytest.mark.parametrize("name", list(commands()))
def test_examples_in_help_texts_parse(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = example(commands()[name])[1:]
    monkeypatch.chdir(tmp_path)
    for file in (Path(word) for word in words if word.endswith((".csv", ".json"))):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    assert cli.make_parser().parse_args(words).run


def test_help_and_usage_errors_load_nothing_slow() -> None:
    slow = ["torch", "numpy", "pandas", "scipy", "matplotlib", "tqdm"]
    code = f"""
import contextlib, io, sys
from nfriction.cli import main
asked = [["--help"], ["--version"], *([name, "--help"] for name in {list(commands())})]
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    for words in asked:
        try:
            main(words)
        except SystemExit as end:
            assert end.code == 0
    for wrong in (["nothing"], ["fit"], ["fit", "absent.csv", "--rig", "emps"], ["demo", "--seed"],
                  ["demo", "--models="], ["compare", "--rig", "nowhere"], ["info", "absent.json"]):
        assert main(wrong) == 2
assert not set({slow}) & set(sys.modules), set({slow}) & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_version_and_bare_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"nfriction {__version__}\n"
    assert cli.main([]) == 2
    assert "usage: nfriction" in capsys.readouterr().err


def test_installed_command_fails_in_one_line() -> None:
    words = [sys.executable, "-m", "nfriction", "fit", "absent.csv", "--rig", "tlrip"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.fullmatch(r"nfriction: error: .*absent\.csv.*\n", done.stderr)


def test_python_advice_is_translated_to_command_line_options() -> None:
    advice = "torques are late (`fit_delay=True`, or `recording.advance_torque(-0.03)`). Corrected"
    assert one_line(advice) == "torques are late (--fit-delay). Corrected"
    assert one_line('not: `encoder_reference="shared"`') == "not: --encoder-reference shared"
    assert one_line("`columns` or `degrees=True`") == "--columns or --degrees"


def test_debug_shows_the_error_itself(bench: Path) -> None:
    (bench / "none.csv").touch()
    with pytest.raises(ValueError, match="is empty"):
        cli.main(["fit", str(bench / "none.csv"), "--rig", "emps", "--debug"])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--windows", "0"], "--windows: must be positive"),
        (["--windows=-1"], "--windows: must be positive"),
        (["--windows", "1,nan"], "--windows: must be positive"),
        (["--max-steps", "-1"], "whole number"),
        (["--models", ","], "viscous (NCFM)"),
        (["--models", "NCFM,FOO"], "viscous (NCFM)"),
        (["--models", "NCFM,stribek"], "did you mean stribeck?"),
        (["--rig", "nowhere"], "multiarm-triple"),
        (["--rig", "multiarm_triple"], "did you mean multiarm-triple?"),
        (["--rig", "absent.json"], "absent.json does not exist"),
        (["--angles", "sideways"], "absolute,hanging"),
        (["--fit-plant=guess"], "--help"),
        (["--columns", "time"], "time=t,q1=enc_1"),
        (["--columns", "speed=v"], "--columns maps time, q1"),
        (["--initial-states", "absent.csv"], "absent.csv"),
    ],
)
def test_invalid_options_are_refused(bench: Path, failing, more: list[str], message: str) -> None:
    words = ["compare", bench / "a.csv.gz", "--rig", bench / "bench.json", "--out", bench / "bad"]
    assert message in failing(*words, *more)
    assert not (bench / "bad").exists()


def test_output_paths_blocked_by_files_are_refused(bench: Path, failing) -> None:
    words = [bench / "a.csv.gz", "--rig", bench / "bench.json", "--out"]
    for out in (bench / "b.csv", bench / "b.csv" / "under"):
        assert "in its way" in failing("compare", *words, out)
    assert "is a folder" in failing("fit", *words, bench)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root writes anywhere")
def test_read_only_folder_is_refused(bench: Path, failing) -> None:
    locked = bench / "locked"
    locked.mkdir(mode=0o500)
    words = ["compare", bench / "a.csv.gz", "--rig", bench / "bench.json", "--out", locked]
    assert "ermission denied" in failing(*words)


def test_export_info_and_demo_refuse_unsupported_requests(
    bench: Path, compared: Path, failing
) -> None:
    for command in ("export", "info"):
        assert "check the path" in failing(command, bench / "absent.json")
        assert "model file" in failing(command, bench / "bench.json")
    model = compared / "models" / "NCFM.json"
    assert "torchscript" in failing("export", model, "--format", "basic")
    assert "number above 0" in failing("demo", "--seconds", "nan")
    assert "whole number" in failing("demo", "--seed", "-1")
    assert "viscous (NCFM)" in failing("demo", "--models", "FOO")


@pytest.mark.skipif(os.name != "posix", reason="pipes end otherwise there")
@pytest.mark.parametrize(
    ("words", "unbuffered"),
    [
        (["--version"], ""),
        (["--version"], "1"),
        pytest.param(["info"], "", marks=pytest.mark.slow),
    ],
)
def test_a_closed_pipe_ends_quietly(words: list[str], unbuffered: str, tmp_path: Path) -> None:
    if words == ["info"]:
        save(NCFM(2), tmp_path / "NCFM.json")
        words = ["info", str(tmp_path / "NCFM.json")]
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "nfriction", *words]
    env = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, timeout=60, env=env)
    os.close(writer)
    assert done.stderr == b""
    # argparse of some Python versions ignores its own write errors.
    assert done.returncode in ({0, 141} if unbuffered and "--version" in words else {141})
