"""The estimator recovers true parameters and follows scikit-learn's rules."""

import dataclasses
import inspect

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import ALFM, LFM, NCFM, LinearAxis, Recording, fit, rollout, score
from nfriction.evaluation.estimators import FrictionEstimator
from nfriction.evaluation.lead_in import lead_in_samples
from nfriction.friction.memory import LuGre
from tests.fitting.recordings import driven_axis, pendulum, swing

pytest.importorskip("sklearn")

TRUE = [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]]
STARTS = ((1.6, 0.8), (2.0, 0.2), (1.2, -0.5))
# Torques need one linear least squares: these tests cover the estimator, not the search.
QUICK = {"method": "equation_error"}


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    model = LFM(2, TRUE, v_smooth=0.05)
    return [swing(pendulum(), model, seconds=1.5, start=s, name=f"r{k}")
            for k, s in enumerate(STARTS)]  # fmt: skip


@pytest.fixture(scope="module")
def fitted(recordings: list[Recording]) -> FrictionEstimator:
    start = LFM(2, v_smooth=0.05)
    return FrictionEstimator(pendulum(), start, **QUICK).fit(recordings[:2])


def test_true_coefficients_are_recovered(fitted: FrictionEstimator) -> None:
    true = LFM(2, TRUE, v_smooth=0.05).requires_grad_(False)
    qd = np.linspace(-3, 3, 20).reshape(10, 2)
    tau = true(*map(torch.tensor, (qd, np.zeros_like(qd), np.ones_like(qd)))).numpy()
    # Torques come from twice differentiated encoder counts of 8e-4 rad.
    assert np.linalg.norm(fitted.predict(qd) - tau) < 0.3 * np.linalg.norm(tau)
    assert fitted.coef_names_ == ["B", "C"]
    assert fitted.n_joints_ == 2
    assert fitted.coef_.shape == (fitted.n_joints_, len(fitted.coef_names_))
    assert fitted.fit_.converged
    assert isinstance(fitted.model, LFM)
    assert fitted.model_ is not fitted.model  # given arguments are unchanged


def test_result_equals_a_fit_with_the_same_settings(
    fitted: FrictionEstimator, recordings: list[Recording]
) -> None:
    own = fit(LFM(2, v_smooth=0.05), pendulum(), recordings[:2], **QUICK)
    np.testing.assert_array_equal(own.model.schedule.values.numpy(), fitted.coef_)
    judged = score(own.plant, own.model, recordings[2], horizons=(1.0,)).windows["1"].all
    assert fitted.set_params(horizon=1.0).score(recordings[2]) == -judged
    fitted.set_params(horizon=5.0)


def test_predicts_the_torque_of_its_model(
    fitted: FrictionEstimator, recordings: list[Recording]
) -> None:
    qd = np.linspace(-4, 4, 10).reshape(5, 2)
    np.testing.assert_allclose(fitted.predict(qd), -fitted.predict(-qd), rtol=1e-12)
    given = fitted.predict(qd, np.ones_like(qd), np.full_like(qd, 2.0))
    tensors = (torch.tensor(x) for x in (qd, np.ones_like(qd), np.full_like(qd, 2.0)))
    np.testing.assert_array_equal(given, fitted.model_(*tensors).numpy())
    along = fitted.predict(recordings[2])
    assert along.shape == recordings[2].q.shape
    for wrong in (qd[0], qd[:, :1], np.zeros((5, 3))):
        with pytest.raises(ValueError, match=r"`X` must have shape \(sample, 2\)"):
            fitted.predict(wrong)
    with pytest.raises(ValueError, match=r"`load` must have shape \(5, 2\)"):
        fitted.predict(qd, load=np.ones((4, 2)))


def test_hidden_state_follows_the_samples(fitted: FrictionEstimator) -> None:
    """Over successive samples, an adaptive model's classes are those a controller would see."""
    rng = np.random.default_rng(0)
    model = ALFM(2, rng.uniform(1e-4, 1e-2, (2, 3, 2)).tolist())
    estimator = FrictionEstimator(pendulum(), "ALFM")
    estimator.fit_ = dataclasses.replace(fitted.fit_, model=model.requires_grad_(False))
    qd, qdd = rng.normal(size=(2, 50, 2)) * [[[3.0]], [[60.0]]]
    state, expected = None, []
    for v, a in zip(*map(torch.tensor, (qd, qdd)), strict=True):
        state = model.initial_state(v, a) if state is None else model.advance(v, a, state)
        held = model.coefficients_from(v, a, state)
        expected.append(model.torque(v, torch.ones_like(v), held).numpy())
    np.testing.assert_allclose(estimator.predict(qd, qdd), expected, rtol=1e-12)
    with pytest.raises(AttributeError, match="follow the motion"):
        _ = estimator.coef_


def test_law_with_memory_is_evaluated_along_a_recording(fitted: FrictionEstimator) -> None:
    """Its torques, below breakaway and sliding, equal those of the rollout that was recorded."""
    model = LuGre(1, [1.0, 0.5, 0.05, 300.0, 5.0, 0.4]).requires_grad_(False)
    time = np.arange(3001) * 1e-3
    tau = (np.array([0.7, 2.0])[(time > 1.5).astype(int)] * np.sin(6 * time))[:, None]
    zero, axis = torch.zeros(1, dtype=torch.float64), LinearAxis(0.5)
    run = rollout(axis, model, zero, zero, torch.tensor(tau[:-1]), sample_time=1e-3)
    recording = Recording(time, run.q.numpy(), tau=tau, unit="m")
    estimator = FrictionEstimator(axis, "lugre")
    estimator.fit_ = dataclasses.replace(fitted.fit_, model=model, plant=axis)
    found = estimator.predict(recording)[10:-10]
    true = (tau - 0.5 * np.gradient(run.qd.numpy(), time, axis=0))[10:-10]
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.02 * true.std()
    with pytest.raises(ValueError, match="has an internal state"):
        estimator.predict(run.qd.numpy())


def test_simulation_is_a_table_like_that_of_the_recording(
    fitted: FrictionEstimator, recordings: list[Recording]
) -> None:
    measured = recordings[2].to_pandas()
    simulated = fitted.simulate(recordings[2])
    assert list(simulated.columns) == ["time", "q1", "q2"]
    assert simulated.attrs == measured.attrs
    error = (simulated - measured)[["q1", "q2"]].to_numpy()
    assert not (simulated - measured)["time"].any()
    free_run = score(fitted.plant_, fitted.model_, recordings[2]).free_run.all
    scored = error[lead_in_samples(recordings[2]) :]
    assert np.sqrt(np.mean(scored**2)) == pytest.approx(free_run, rel=1e-12)


def test_tables_are_accepted_as_recordings(
    fitted: FrictionEstimator, recordings: list[Recording]
) -> None:
    tables = [r.to_pandas() for r in recordings]
    assert fitted.score(tables) == fitted.score(recordings)
    pd.testing.assert_frame_equal(fitted.simulate(tables[0]), fitted.simulate(recordings[0]))


def test_table_without_a_unit_has_that_of_the_plant() -> None:
    axis, message = LinearAxis(2.0), "table 1 is in rad, the plant's joints are in m"
    table = driven_axis(axis, LFM(1, [[3.0, 2.0]])).to_pandas()
    plain = pd.DataFrame(table.to_numpy(), columns=table.columns)
    found = FrictionEstimator(axis, "LFM", **QUICK).fit(plain)
    assert found.simulate(plain).shape == (len(plain), 2)
    table.attrs["unit"] = "rad"
    with pytest.raises(ValueError, match=message):
        FrictionEstimator(axis, "LFM", **QUICK).fit(table)


def test_true_law_scores_higher(fitted: FrictionEstimator, recordings: list[Recording]) -> None:
    other = FrictionEstimator(pendulum(), NCFM(2), **QUICK).fit(recordings[:2])
    assert other.score(recordings[2:]) < fitted.score(recordings[2:]) < 0


def test_parameters_are_kept_as_given_and_shown() -> None:
    plant, windows = pendulum(name="rig"), [0.5]
    estimator = FrictionEstimator(plant, "NLFM", windows=windows)
    names = list(inspect.signature(FrictionEstimator).parameters)
    assert set(estimator.get_params()) == set(names) > {"plant", "model", "horizon", "max_steps"}
    assert estimator.get_params()["plant"] is plant
    assert estimator.get_params()["windows"] is windows
    assert estimator.set_params(model="CFM", drag=True) is estimator
    for argument in ("drag=True", "model='CFM'", "windows=[0.5]", "rig"):
        assert argument in repr(estimator)
    assert "max_steps" not in repr(estimator)
    with pytest.raises(ValueError, match="Invalid parameter 'law'"):
        estimator.set_params(law="LFM")
    with pytest.raises(TypeError, match="`fit` has no setting law"):
        FrictionEstimator(plant, law="LFM")


def test_misuse_raises_clear_errors(recordings: list[Recording]) -> None:
    with pytest.raises(ValueError, match="not fitted yet"):
        FrictionEstimator(pendulum()).predict(np.zeros((1, 2)))
    with pytest.raises(ValueError, match="`plant` is missing"):
        FrictionEstimator().fit(recordings)
    with pytest.raises(ValueError, match="no friction model is called"):
        FrictionEstimator(pendulum(), "XFM").fit(recordings)
    for wrong in (recordings[0].q, [recordings[0].q], 5):
        with pytest.raises(TypeError, match="a recording is a Recording, the path"):
            FrictionEstimator(pendulum()).fit(wrong)
    with pytest.raises(ValueError, match="a recording or a list of recordings is needed"):
        FrictionEstimator(pendulum()).fit([])
    with pytest.raises(FileNotFoundError, match=r"a\.csv"):
        FrictionEstimator(pendulum()).fit("a.csv")
    with pytest.raises(ValueError, match="no rig 'penduluum'"):
        FrictionEstimator("penduluum").fit(recordings)


@pytest.mark.slow
def test_estimator_works_in_grid_search_and_cross_validation(recordings: list[Recording]) -> None:
    sklearn = pytest.importorskip("sklearn")
    from sklearn.model_selection import GridSearchCV, LeaveOneOut, cross_val_score
    from sklearn.utils.validation import check_is_fitted

    estimator = FrictionEstimator(pendulum(), **QUICK)
    copy = sklearn.clone(estimator.set_params(horizon=2.0))
    assert copy is not estimator
    assert copy.get_params()["horizon"] == 2
    with pytest.raises(sklearn.exceptions.NotFittedError):
        check_is_fitted(copy)
    search = GridSearchCV(copy, {"model": ["NCFM", "LFM"]}, cv=LeaveOneOut())
    search.fit(recordings)
    assert search.best_params_ == {"model": "LFM"}
    check_is_fitted(search.best_estimator_)
    assert search.best_estimator_.coef_names_ == ["B", "C"]
    assert search.score(recordings) < 0
    scores = cross_val_score(copy.set_params(model="LFM"), recordings, cv=LeaveOneOut())
    assert scores.shape == (len(recordings),)
    # The mean of the search is over the same three scores.
    found = search.cv_results_["mean_test_score"][
        list(search.cv_results_["param_model"]).index("LFM")
    ]
    assert scores.mean() == pytest.approx(found, rel=1e-9)
