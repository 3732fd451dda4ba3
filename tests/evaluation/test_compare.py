"""Comparisons: every model fitted and scored, tables with names, results as plain JSON."""

import dataclasses
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nfriction import CVFM, LFM, NFLFM, LinearAxis, PendulumChain, Recording, Rotor, compare
from nfriction.cli.tables import error_tables, fit_lines, verdict
from nfriction.evaluation.compare import Comparison, Data, Fits, _farther, coefficient_summary
from nfriction.evaluation.parallel import Progress
from nfriction.evaluation.results import write_results
from nfriction.evaluation.score import RMSE, Errors, Score
from nfriction.io.model_file import load_info
from nfriction.papers.afem.adaptive import ALFM
from nfriction.signals import Motion, kalman_smoother
from tests.fitting.recordings import driven_axis, pendulum, swing

MODEL = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=0.05)
A, B = (swing(pendulum(), MODEL, seconds=1.5, start=s, name=n)
        for s, n in (((1.6, 0.8), "a"), ((2.0, 0.2), "b")))  # fmt: skip


class Stages(Progress):
    def __init__(self):
        self.labels = []

    def stage(self, what):
        self.labels.append(what)


@pytest.fixture(scope="module")
def comparison():
    stages = Stages()
    found = compare(pendulum(), ["NCFM", "LFM", "NCFM"], [A], [B], horizons=(0.5, 1.0),
                    progress=stages, windows=(0.5,), max_steps=3)  # fmt: skip
    return found, stages


def test_tables_have_one_row_per_model_and_one_column_per_joint(comparison):
    found, stages = comparison
    for horizon in (None, "0.5", "1"):
        for part in ("train", "test"):
            table = found.table(horizon, part=part)
            assert list(table.index) == ["no friction", "NCFM", "LFM"]
            assert list(table.columns) == [*found.joint_names, "all"]
            assert (table > 0).all().all()
    assert found.horizons() == ["0.5", "1"]
    saved = found.improvement()
    assert (saved.loc["no friction"] == 0).all()
    assert (saved.loc["LFM"] > 0).all()
    assert stages.labels[:2] == ["fit NCFM", "fit LFM"]


def test_repr_names_the_best_model_in_a_few_lines(comparison):
    found, _ = comparison
    head, *rows = repr(found).splitlines()
    assert head.endswith("test recordings, best: LFM")
    table = found.table()
    assert rows[0].split()[-1] == "all"
    for row, (name, errors) in zip(rows[2:], table.iterrows(), strict=True):
        assert row.startswith(name)
        assert float(row.split()[-1]) == pytest.approx(1e3 * errors["all"], rel=1e-3)
    text = repr(dataclasses.replace(found, failed={"ALFM": "no classes"}, test={}))
    assert "training recordings, best: None" in text
    assert text.endswith("not fitted: ALFM: no classes")


def test_fits_are_found_by_plain_names_and_shown_in_a_notebook(comparison):
    found, _ = comparison
    assert found.fits["load-coulomb"] is found.fits["LFM"]
    with pytest.raises(KeyError, match=r"stribeck; there are viscous \(NCFM\)"):
        found.fits["stribeck"]
    with pytest.raises(KeyError, match="no friction; there are viscous"):
        found.fits["no friction"]
    page = found._repr_html_()
    assert "load-coulomb (LFM)" in page
    assert f"{1e3 * found.table()['all']['LFM']:.4g}" in page


def test_one_name_and_one_recording_need_no_list():
    settings = {"horizons": (0.5,), "windows": (0.5,), "max_steps": 1}
    one = compare(pendulum(), "viscous", A, B, **settings)
    many = compare(pendulum(), ["NCFM"], [A], [B], **settings)
    assert one.to_dict() == many.to_dict()


def test_failed_models_are_kept_with_the_reason(comparison):
    found, _ = comparison
    assert "failed" not in found.to_dict()
    assert dataclasses.replace(found, failed={"ALFM": "x"}).to_dict()["failed"] == {"ALFM": "x"}


def test_data_frame_has_every_error_once(comparison):
    found, _ = comparison
    table = found.to_frame()
    keys = ["model", "recording", "part", "horizon", "joint"]
    assert list(table.columns) == [*keys, "rmse [rad]"]
    assert not table.duplicated(keys).any()
    # (models and limit) × kinds × (free run and two horizons) × (joints and all)
    assert len(table) == 4 * 2 * 3 * 3
    limit = table[(table.model == "limit of these data") & (table.part == "test")]
    of = found.test[found.best()][0].limit
    assert limit["rmse [rad]"].tolist() == [
        x for e in (of.free_run, *of.windows.values()) for x in (*e.joints, e.all)
    ]
    metres = dataclasses.replace(found, unit="m").to_frame()
    assert "rmse [m]" in metres.columns


def test_results_are_plain_json_with_the_documented_keys(comparison):
    found, _ = comparison
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["units"] == "rad"
    lfm = data["models"]["LFM"]
    assert set(lfm["coefficients"]) == {"B", "C"}
    for kind, name in (("test", "b"), ("train", "a")):
        scores = lfm[kind][name]
        assert set(scores["windows"]) == {"0.5", "1"}
        for rmse in (scores["free_run"], *scores["windows"].values()):
            assert len(rmse["joints"]) == 2
            mean = sum(x * x for x in rmse["joints"]) / 2
            assert rmse["all"] == pytest.approx(mean**0.5)
    assert "coefficients" not in data["models"]["no friction"]


def test_recording_names_must_be_unique():
    with pytest.raises(ValueError, match="a repeats; rename one"):
        compare(pendulum(), ["NCFM"], [A], [dataclasses.replace(B, name="a")])
    unnamed = [dataclasses.replace(r, name="") for r in (A, B)]
    with pytest.raises(ValueError, match=r"different names, the empty one repeats; .*`name`"):
        compare(pendulum(), ["NCFM"], *unnamed)
    with pytest.raises(ValueError, match="at least one"):
        compare(pendulum(), [], [A])
    with pytest.raises(ValueError, match="there are"):
        compare(pendulum(), ["NOPE"], [A])


def test_renamed_training_recording_is_refused_as_test():
    for name in ("a", "copy"):
        with pytest.raises(ValueError, match=rf"{name}: used for training and testing; .*not seen"):
            compare(pendulum(), ["NCFM"], [A], [B, dataclasses.replace(A, name=name)])


def test_test_recording_without_torque_is_named_if_training_has_torque():
    driven = dataclasses.replace(A, tau=np.full_like(A.q, 1e-3))
    with pytest.warns(UserWarning, match=r"no torque is recorded in b, unlike"):
        compare(pendulum(), "NCFM", driven, B, horizons=(0.5,), windows=(0.5,), max_steps=1)


def test_test_recording_faster_than_all_training_data_is_named(recwarn):
    settings = {"horizons": (0.5,), "windows": (0.5,), "max_steps": 1}
    compare(pendulum(), "NCFM", A, B, **settings)
    assert not [w for w in recwarn if "extrapolated" in str(w.message)]
    with pytest.warns(UserWarning, match=r"joint1 of a \(8.79 against 6.08 rad/s\), joint2 of a"):
        compare(pendulum(), "NCFM", B, A, **settings)


@pytest.mark.parametrize(("waves", "reach", "named"), [(2, 1.2, 1), (2, 1.6, 0), (0, 1.0, 0)])
def test_positions_without_training_data_are_named(waves, reach, named):
    """Unless training covers a whole period of the friction by position, or there is none."""
    time = np.linspace(0.0, 1.0, 50)
    near, far = (Motion(time, size * np.cos(6 * time)[:, None], *[0 * time[:, None]] * 2)
                 for size in (reach, 2.0))  # fmt: skip
    plant = Rotor(0.02).replace(load_waves=torch.tensor([waves]).double())
    fits = {"NFCVFM": SimpleNamespace(plant=plant, motions=(near,), encoder_offsets=())}
    said = [*_farther(fits, Data([Recording(time, far.q, name="t")], [far]))]
    assert len(said) == named
    assert all("NFCVFM: " in text and "joint1 of t (-2 to 2 against -1." in text for text in said)


def test_direction_without_training_data_is_named():
    time = np.arange(0.0, 2.0, 2e-3)
    forward = (10 * time - time**2)[:, None]
    parts = (Recording(time, q, name=name) for q, name in ((forward, "a"), (-0.9 * forward, "b")))
    with pytest.warns(UserWarning, match=r"joint1 of b \(-[89]\.\d+ against 0 rad/s\); train"):
        compare(Rotor(0.02), "NCFM", *parts, horizons=(0.5,), windows=(0.5,), max_steps=1)


def test_a_mistake_in_a_test_recording_is_named(recwarn):
    settings = {"horizons": (0.5,), "windows": (0.5,), "max_steps": 1}
    compare(pendulum(), "NCFM", A, B, **settings)
    assert not [w for w in recwarn if "likely" in str(w.message) or "unit" in str(w.message)]
    off = dataclasses.replace(B, q=B.q + np.array([0.0, np.pi / 2]))
    with pytest.warns(
        UserWarning, match=r"b: A mistake .* likely: joint2's position is 90 degrees"
    ):
        found = compare(pendulum(), "NCFM", A, off, **settings)
    assert "90 degrees" in found.to_dict()["test_warnings"][0]
    small = dataclasses.replace(B, q=np.deg2rad(B.q))
    with pytest.warns(UserWarning, match=r"joint1 changes by 1.34e-05 rad in b, by at least"):
        compare(pendulum(), "NCFM", A, small, **settings)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"friction": 1.5}, r"the friction of joint1 is 1\.[45]\d* times theirs"),
        pytest.param(
            {"gain": 1.3},
            r"the force of joint1 is 1\.(29|3)\d* times theirs",
            marks=pytest.mark.slow,
        ),
        ({"bias": 0.1}, r"the force of joint1 has an offset of 0\.(09|1)\d* N"),
        # A mistake with a specific name.
        pytest.param({"gain": -1.0}, "", marks=pytest.mark.slow),
        ({}, ""),
    ],
)
def test_a_test_recording_that_differs_from_training_is_named(recwarn, change, text):
    axis, recordings = LinearAxis(2.0), []
    for name in ("train", "test"):
        own = change if name == "test" else {}
        truth = CVFM(1, [[0.8 * own.get("friction", 1), 2.0 * own.get("friction", 1)]])
        made = driven_axis(axis, truth.requires_grad_(False), seconds=4.0)
        tau = made.tau * own.get("gain", 1) + own.get("bias", 0)
        # Neither may be a part of the other.
        cut = slice(0, -100) if name == "train" else slice(100, None)
        recordings.append(dataclasses.replace(made, tau=tau, name=name)[cut])
    compare(axis, "CVFM", *recordings, horizons=(0.5,), windows=(0.5,), fit_plant=False)
    messages = [str(w.message) for w in recwarn if "differs from the training" in str(w.message)]
    assert [bool(re.search(text, sentence)) for sentence in messages] == [True] * bool(text), (
        messages
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        pytest.param(
            {"friction": 3.0},
            r"friction of joint1 is 3\.?\d* times and of joint2 is (3|2\.9)\d* times theirs",
            marks=pytest.mark.slow,
        ),
        # Hardly visible in the torque, but clear over seconds of motion.
        ({"friction": 1.1}, r"free: the best fit errs by .* times the limit of these data; in"),
        ({"of joint1": 4.0}, r"ings: the friction of joint1 is (4|3\.9)[.\d]* times theirs"),
        ({"zero": 0.1}, r"the encoder of joint2 has another zero, 5\.[78]\d* degrees off"),
        ({}, ""),
    ],
)
def test_undriven_test_recording_that_differs_is_named(recwarn, change, text):
    rig = PendulumChain([0.5, 0.3], [0.3, 0.25])
    recordings = []
    for name, start in (("train", (2.0, 0.2)), ("free", (2.2, 0.5))):
        own = change if name == "free" else {}
        values = own.get("friction", 1) * np.array([[0.02, 0.005], [0.008, 0.003]])
        values[0] *= own.get("of joint1", 1)
        truth = CVFM(2, values.tolist(), v_smooth=0.01).requires_grad_(False)
        made = swing(rig, truth, seconds=4.0, start=start)
        q = made.q + np.array([0.0, own.get("zero", 0.0)])
        recordings.append(dataclasses.replace(made, q=q, name=name))
    compare(rig, "CVFM", *recordings, horizons=(1.0,), windows=(0.5,), drag=False)
    messages = [str(w.message) for w in recwarn if str(w.message).startswith("free: ")]
    assert [bool(re.search(text, sentence)) for sentence in messages] == [True] * bool(text), (
        messages
    )


def test_part_of_a_training_recording_is_refused_as_test():
    piece = dataclasses.replace(A[200:600], name="piece")
    with pytest.raises(ValueError, match="piece: used for training and testing"):
        compare(pendulum(), "NCFM", A, piece)


def test_noise_at_rest_is_not_taken_for_faster_motion(recwarn):
    rng = np.random.default_rng(0)
    still = [
        dataclasses.replace(x, q=x.q[:1] + size * rng.normal(size=x.q.shape))
        for x, size in ((A, 1e-5), (B, 2e-5))
    ]
    settings = {"horizons": (0.5,), "windows": (0.5,), "max_steps": 1}
    compare(pendulum(), "NCFM", *still, **settings)
    assert not [w for w in recwarn if "extrapolated" in str(w.message)]


def test_without_test_recordings_there_is_no_test_table(comparison):
    found = compare(pendulum(), ["NCFM"], [A], horizons=(0.5,), windows=(0.5,), max_steps=1)
    assert found.table(part="train").shape == (2, 3)
    with pytest.raises(ValueError, match="test"):
        found.table()
    assert set(found.to_dict()["models"]) == {"no friction", "NCFM"}


def test_frictionless_baseline_uses_the_plant_as_given(comparison):
    found, _ = comparison
    other = compare(pendulum(), ["LFM"], [A], [B], horizons=(0.5,), windows=(0.5,), max_steps=2)
    for kind in ("train", "test"):
        (before,), (after,) = (getattr(c, kind)["no friction"] for c in (found, other))
        assert before.free_run == after.free_run
        assert before.windows["0.5"] == after.windows["0.5"]


def test_every_recording_is_smoothed_once(monkeypatch):
    smoothed = []

    def counting(time, q, **settings):
        smoothed.append(len(time))
        return kalman_smoother(time, q, **settings)

    for user in ("evaluation.compare", "fitting.data.inputs"):
        monkeypatch.setattr(f"nfriction.{user}.kalman_smoother", counting)
    compare(pendulum(), ["NCFM", "LFM"], [A], [B], windows=(0.5,), max_steps=1)
    # No score needs the smoothed motion; the test recording's is used for its speed.
    assert len(smoothed) == 2


def test_recordings_too_short_for_a_window_are_named(comparison):
    found, _ = comparison
    assert found.too_short() == found.too_short("train") == {}
    asked = dataclasses.replace(found, horizons_asked=(1.0, 2.0))
    assert asked.too_short() == {"2": {"b": pytest.approx(1.5)}}
    # A window length that one set of recordings is too short for is still used for the other.
    shorter = {n: [dataclasses.replace(s, windows={}) for s in of] for n, of in found.train.items()}
    mixed = dataclasses.replace(found, train=shorter)
    assert mixed.horizons() == mixed.horizons("train") == []
    assert mixed.horizons("test") == ["0.5", "1"]


def scored(found: Comparison, limit: float | None = None, **errors: float) -> Comparison:
    """A comparison with these free-run errors and this limit.

    Errors are those of each of two recordings; the limit is that of the first, and twice that of
    the second.
    """
    test = {
        name.replace("_", " "): [
            Score(
                RMSE((e, e), e), {},
                None if limit is None else Errors(RMSE((0.0, 0.0), k * limit), {}),
                recording, np.zeros(1), np.zeros((1, 2)), np.inf,
            )
            for k, recording in enumerate("bc", 1)
        ]
        for name, e in errors.items()
    }  # fmt: skip
    return dataclasses.replace(found, test=test)


def best_of(found: Comparison, **errors: float) -> str | None:
    """The best model of a comparison with these free-run errors."""
    return scored(found, **errors).best()


def test_best_model_has_the_least_error_and_of_equals_is_the_simplest(comparison):
    found, _ = comparison
    assert found.to_dict()["best"]["model"] == found.best() == "LFM"
    # Fits that are good come before others.
    fits = {name: dataclasses.replace(fit, converged=False) for name, fit in found.fits.items()}
    found = dataclasses.replace(found, fits=fits)
    assert best_of(found, no_friction=3.0, NCFM=2.0, LFM=1.0) == "LFM"
    assert best_of(found, no_friction=3.0, LFM=1.0, NCFM=1.0005) == "NCFM"
    assert best_of(found, no_friction=3.0, LFM=1.0, NCFM=1.002) == "LFM"
    assert best_of(found, no_friction=1.0, NCFM=1.0, LFM=2.0) == "no friction"
    assert best_of(found, no_friction=np.inf, NCFM=np.inf, LFM=4.0) == "LFM"
    assert best_of(found, no_friction=np.inf, NCFM=np.inf, LFM=np.inf) is None
    alone = dataclasses.replace(found, test={})
    assert alone.best() is None
    assert alone.to_dict()["best"] is None


def test_models_within_the_limit_of_the_best_are_indistinguishable(comparison):
    found, _ = comparison
    errors = {"no_friction": 5.0, "NCFM": 2.0, "LFM": 1.0}
    assert scored(found, **errors).indistinguishable() == ("LFM",)
    assert "tied" not in verdict(scored(found, **errors))
    # Without a limit equal errors prove nothing, such as those of a network that kept its law.
    equal = scored(found, no_friction=5.0, NCFM=1.0, LFM=1.0)
    assert equal.indistinguishable() == (equal.best(),)
    near, far = scored(found, 0.7, **errors), scored(found, 0.6, **errors)
    # Over both recordings the limit is root 2.5 times as large: 1.1 and 0.95.
    assert near.limit() == pytest.approx(0.7 * 2.5**0.5)
    assert near.limit(column="joint1") == 0
    assert near.indistinguishable() == ("NCFM", "LFM")
    assert far.indistinguishable() == ("LFM",)
    assert near.best() == far.best() == "LFM"
    assert near.to_dict()["best"]["indistinguishable"] == ["NCFM", "LFM"]
    assert "statistically tied with NCFM (" in verdict(near)
    assert verdict(near).endswith("; the simplest of them is NCFM")
    printed = error_tables(near)
    assert re.search(r"limit of these data +0 +0 +1107\n", printed)
    # Joints are exact here, and over all of them the two are tied.
    assert re.search(r"NCFM +2000 +2000 +2000= +60\n", printed)
    assert re.search(r"LFM +1000 +1000 +1000= +80\n", printed)
    assert "=" not in error_tables(far).partition("free run: one")[0]
    assert verdict(far).count("\n") == 0
    all_alike = scored(found, 10.0, **errors)
    assert all_alike.indistinguishable() == ("no friction", "NCFM", "LFM")
    assert scored(found, np.inf, **errors).limit() is None
    assert dataclasses.replace(found, test={}).indistinguishable() == ()


def test_chaotic_motion_is_judged_over_windows_that_can_be_predicted(comparison):
    found, _ = comparison

    def chaotic(name: str, free: float, *windows: float) -> Score:
        def rmse(*errors: float) -> dict[str, RMSE]:
            return {h: RMSE((e, e), e) for h, e in zip(("0.5", "1"), errors, strict=True)}

        limit = Errors(RMSE((9.0, 9.0), 9.0), rmse(0.05, 2.0))
        return Score(
            RMSE((free, free), free), rmse(*windows), limit,
            "b", np.zeros(1), np.zeros((1, 2)), np.inf,
        )  # fmt: skip

    errors = {"no friction": (7.0, 3.0, 3.0), "NCFM": (8.0, 0.1, 5.0), "LFM": (6.5, 0.3, 1.0)}
    judged = dataclasses.replace(found, test={n: [chaotic(n, *e)] for n, e in errors.items()})
    assert judged.judged_over() == "0.5"
    assert judged.best() == "NCFM"
    assert judged.indistinguishable() == ("NCFM",)
    assert judged.unfit() == {
        "LFM": "NCFM, with no more parameters, errs by 100 mrad, this model by 300 mrad"
    }
    assert "best on test recordings: NCFM (windows of 0.5 s, as the free run is" in verdict(judged)
    by = judged.to_dict()["best"]
    assert by["by"] == "0.5 s window RMSE over all joints and test recordings"
    assert by["limit"] == 0.05
    assert scored(found, 0.7, no_friction=5.0, LFM=1.0).judged_over() is None


def test_a_doubtful_model_is_not_the_best_if_a_good_one_is_no_worse(comparison):
    found, _ = comparison
    good = {n: dataclasses.replace(f, residual=0.0, converged=True) for n, f in found.fits.items()}
    unidentifiable = dataclasses.replace(good["LFM"], unidentifiable=("C of joint1",))
    doubtful = dataclasses.replace(found, fits=Fits({**good, "LFM": unidentifiable}))
    assert [fit.usability[0] for fit in doubtful.fits.values()] == ["good", "doubtful"]
    near = scored(doubtful, 0.7, no_friction=5.0, NCFM=2.0, LFM=1.0)
    assert near.best() == "NCFM"
    assert near.indistinguishable() == ("NCFM", "LFM")
    assert "best on test recordings: NCFM" in verdict(near)
    assert "times the limit" not in verdict(near)
    far = verdict(scored(doubtful, 0.1, no_friction=5.0, NCFM=2.0, LFM=1.0))
    assert "best on test recordings: LFM (free run over all joints: 1e+03 mrad, 6 times the" in far
    assert "statistically tied with LFM (doubtful) (" in verdict(near)
    assert scored(doubtful, 0.6, no_friction=5.0, NCFM=2.0, LFM=1.0).best() == "LFM"


def test_model_far_worse_than_one_of_equal_size_is_not_fit_for_use(comparison, tmp_path):
    found, _ = comparison
    assert scored(found, no_friction=5.0, NCFM=1.0, LFM=1.9).unfit() == {}
    runaway = scored(found, no_friction=5.0, NCFM=1.0, LFM=2.1)
    assert set(runaway.unfit()) == {"LFM"}
    assert "not fit for use: LFM: NCFM, with no more parameters, errs by" in verdict(runaway)
    line = fit_lines("LFM", runaway.fits["LFM"], runaway.rating("LFM"))
    assert line.startswith("LFM: do not use (in the test, NCFM, with no more parameters, errs by")
    assert runaway.to_dict()["unfit"] == runaway.unfit()
    write_results(runaway, [A], [B], tmp_path, figures=False)
    # The verdict is stored for a later export.
    stated = load_info(tmp_path / "models" / "LFM.json").rating
    assert stated.startswith("do not use: in the test, NCFM, with no more parameters, errs by")
    assert (
        "this model diverges" in scored(found, no_friction=5.0, NCFM=1.0, LFM=np.inf).unfit()["LFM"]
    )
    worse = scored(found, no_friction=1.0, NCFM=1.2, LFM=1.3).unfit()
    assert worse == dict.fromkeys(("NCFM", "LFM"), "no friction predicts better")
    # An equal number of parameters does not matter.
    equal = dataclasses.replace(found, fits={**found.fits, "CVFM": found.fits["LFM"]})
    assert set(scored(equal, no_friction=5.0, CVFM=1.0, LFM=2.1).unfit()) == {"LFM"}
    # A smaller model gets the same verdict for the same error.
    errors = {"no_friction": 5.0, "NCFM": 2.1, "CVFM": 1.0, "LFM": 2.1}
    reasons = scored(equal, **errors).unfit()
    assert reasons["NCFM"] == "it predicts no better than LFM, not to be used"
    assert set(scored(equal, **errors | {"NCFM": 2.0}).unfit()) == {"LFM"}
    # The data do not separate these.
    assert scored(found, 10.0, no_friction=5.0, NCFM=1.0, LFM=3.0).unfit() == {}
    # Near sticking, noise alone can cause such an error of the true law: the best one was lucky.
    errors = {"no_friction": 9.0, "NCFM": 1.0, "LFM": 3.0}
    sensitive = scored(found, 0.1, **errors)
    sensitive.test["LFM"] = scored(found, 3.0, **errors).test["LFM"]
    assert set(scored(found, 0.1, **errors).unfit()) == {"LFM"}
    assert sensitive.unfit() == {}
    # In chaotic motion every law is as sensitive.
    sensitive.test["LFM"] = scored(found, 9.5, **errors).test["LFM"]
    assert set(sensitive.unfit()) == {"LFM"}
    assert dataclasses.replace(found, test={}).unfit() == {}


def test_motion_dependent_coefficients_name_their_reference_motion():
    assert coefficient_summary(LFM(2, [3.0, 4.0])) == {
        "B": pytest.approx([3.0, 3.0]),
        "C": pytest.approx([4.0, 4.0]),
    }
    adaptive = coefficient_summary(ALFM(1, [[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]]))
    assert [adaptive[known]["C"] for known in ("low", "medium", "high")] == [
        pytest.approx([2.0]), pytest.approx([4.0]), pytest.approx([6.0])
    ]  # fmt: skip
    network = NFLFM(1, [3.0, 4.0])
    assert coefficient_summary(network) == {"B": pytest.approx([3.0]), "C": pytest.approx([4.0])}
    network.schedule.set_parameter_vector(network.schedule.parameter_vector() + 0.1)
    fuzzy = coefficient_summary(network)
    assert fuzzy["reference"] == {"B": pytest.approx([3.0]), "C": pytest.approx([4.0])}
    assert fuzzy["at_rest"]["C"] != pytest.approx([4.0], rel=1e-3)
    time = np.linspace(0.0, 1.0, 50)[:, None]
    motion = Motion(time[:, 0], time, 10.0 * time, -100.0 * time)
    along = coefficient_summary(network, [motion])
    passed = network.coefficients(*map(torch.as_tensor, (motion.qd, motion.qdd)))[:, 0, 0].tolist()
    ends = (along[f"{end}_in_training"]["B"] for end in ("lowest", "highest"))
    assert [*ends] == [[min(passed)], [max(passed)]]
    assert min(passed) < max(passed)
