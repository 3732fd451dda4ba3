"""Public recordings: the authors' original files become the tables of the data cards."""

import http.client
import io
import json
import threading
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from nfriction.io.public_data import fetch, public_sets
from nfriction.plant import rigs
from nfriction.recording import Recording, read_initial_states

FOLDERS = {
    "multiarm": "multiarm_pendulum", "dfki": "dfki_double_pendulum", "emps": "emps",
    "xl330": "xl330_servo_pendulum", "tribometer": "presliding_tribometer",
}  # fmt: skip


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(address: str, timeout: float) -> None:
        raise urllib.error.URLError("no network in tests")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)


def put(folder: Path, name: str, recording: str) -> Path:
    """Path of a recording's original file; its folder is created."""
    path = folder / "originals" / public_sets()[name].recordings[recording][0]
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def swing_pieces(q: np.ndarray, qd: np.ndarray, pieces: int) -> dict[str, np.ndarray]:
    """A free swing in the parts of the authors' script: the last part is shorter."""
    parts = np.empty(pieces, dtype=object)
    length = q.shape[1] // pieces + 1
    for k in range(pieces):
        parts[k] = np.concatenate([q, qd])[:, k * length : (k + 1) * length]
    return {"Y_id": parts[:-4, None], "Y_vad": parts[-4:, None]}


def test_free_swings_are_joined_and_cut_in_the_authors_order(tmp_path: Path) -> None:
    time = 1e-3 * np.arange(40001)
    q = np.stack([np.pi + 0.3 * np.cos((2 + k) * time) for k in range(3)])
    qd = np.stack([-0.3 * (2 + k) * np.sin((2 + k) * time) for k in range(3)])
    scipy.io.savemat(put(tmp_path, "multiarm-triple", "triple_b0"), swing_pieces(q, qd, 26))
    fetched = fetch("multiarm-triple", tmp_path)
    assert fetched.differing == ("triple_b0", "triple_b2")  # it is another motion
    plant = rigs.of("multiarm-triple")
    states = read_initial_states(tmp_path / "recordings.csv")
    for table, start in zip(fetched.tables, (20, 20 + 2 * 9980), strict=True):
        frame = pd.read_csv(table)
        np.testing.assert_allclose(
            frame[["q1", "q2", "q3"]].to_numpy().T, q[:, start : start + 9980] - np.pi, atol=6e-7
        )
        recording = Recording.read(table, plant=plant)
        assert recording.joints == 3
        q0, qd0 = states[recording.name]
        np.testing.assert_allclose(q0, q[:, start] - np.pi, atol=1e-6)
        np.testing.assert_allclose(qd0, qd[:, start], atol=1e-4)


def test_servo_logs_are_cut_at_the_release(tmp_path: Path) -> None:
    count = 40
    released = np.arange(count) >= 25
    log = {
        "position": np.linspace(-0.1, 0.1, count), "speed": np.zeros(count),
        "load": np.where(released, 0, 65535), "input_volts": np.full(count, 7.3),
        "temp": np.full(count, 29), "timestamp": 0.003 + 0.005 * np.arange(count),
        "goal_position": np.zeros(count), "torque_enable": ~released,
    }  # fmt: skip
    entries = pd.DataFrame(log).to_dict("records")
    for recording in public_sets()["xl330"].recordings:
        text = json.dumps({"mass": 0.49, "entries": entries})
        put(tmp_path, "xl330", recording).write_text(text)
    fetch("xl330", tmp_path)
    driven = pd.read_csv(tmp_path / "lift_and_drop_kp100.csv.gz")
    dropped = pd.read_csv(tmp_path / "drop_kp100.csv.gz")
    assert len(driven) == count
    np.testing.assert_allclose(driven["duty1"][:2], -1 / 885, atol=5e-6)  # the register is signed
    np.testing.assert_allclose(dropped["time"], 0.005 * np.arange(15), atol=1e-9)
    np.testing.assert_allclose(dropped["q1"], log["position"][25:], atol=5e-7)
    assert (dropped["tau1"] == 0).all()


def test_offline_error_names_url_and_target_path(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"githubusercontent.com/forgi86.*DATA_EMPS.mat.*save it as"):
        fetch("emps", tmp_path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("failure", [http.client.IncompleteRead(b"x"), ConnectionResetError()])
def test_interrupted_download_is_named(
    failure: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Answer(io.BytesIO):
        def read(self, _: int | None = None) -> bytes:
            raise failure

    monkeypatch.setattr(urllib.request, "urlopen", lambda *_, **__: Answer())
    with pytest.raises(OSError, match=r"DATA_EMPS.mat.*save it as"):
        fetch("emps", tmp_path)
    assert not any(tmp_path.iterdir())


def test_partial_original_is_refused(tmp_path: Path) -> None:
    path = put(tmp_path, "emps", "emps_first")
    scipy.io.savemat(path, {"qm": np.linspace(0.0, 1.0, 1000) ** 2}, do_compression=True)
    whole = path.read_bytes()
    for content in (b"", whole[:200]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="fetch it again"):
            fetch("emps", tmp_path)


def test_concurrent_downloads_do_not_interfere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = threading.Barrier(2)
    written = Path.write_bytes

    def write(path: Path, content: bytes) -> int:
        count = written(path, content)
        together.wait(10)
        return count

    monkeypatch.setattr(urllib.request, "urlopen", lambda *_, **__: io.BytesIO(b"<html>"))
    monkeypatch.setattr(Path, "write_bytes", write)
    with ThreadPoolExecutor(2) as both:
        found = [both.submit(fetch, "emps", tmp_path) for _ in range(2)]
    for one in found:
        with pytest.raises(ValueError, match="fetch it again"):
            one.result()


def test_file_with_another_digest_is_refused(tmp_path: Path) -> None:
    put(tmp_path, "tribometer", "tribometer_first").write_text("<html>not found</html>\n")
    with pytest.raises(ValueError, match=r"is not what https.*fetch it again"):
        fetch("tribometer", tmp_path)
    with pytest.raises(ValueError, match="there are multiarm-single, "):
        fetch("trib", tmp_path)


def original_of(source: str, table: pd.DataFrame) -> bytes:
    """An original with the rows of a table, as far as given."""
    if source == "dfki":
        names = {"q": "pos_meas", "qd": "vel_meas", "tau": "tau_meas", "tau_cmd": "tau_con"}
        named = table.rename(columns=lambda c: names.get(c[:-1], c[:-1]) + c[-1])
        return named.to_csv(index=False).encode()
    if source == "tribometer":
        columns = {
            "Time [s]": table["time"], "Normal [uN]": 1e6 * table["normal_force"],
            "Position [mm]": 1e3 * table["position"], "Friction [uN]": -1e6 * table["friction"],
        }  # fmt: skip
        return pd.DataFrame(columns).to_csv(index=False, sep="\t").encode()
    if "tau1" in table:  # of a drop
        table = table.assign(qd1_reg=0, duty1=0, volt=0, q_goal1=0, torque_on=0)
    entries = pd.DataFrame({
        "position": table["q1"], "speed": table["qd1_reg"], "timestamp": table["time"],
        "load": np.round(885 * table["duty1"]).astype(int) % 2**16, "input_volts": table["volt"],
        "goal_position": table["q_goal1"], "torque_enable": table["torque_on"].astype(bool),
    })  # fmt: skip
    return json.dumps({"entries": entries.to_dict("records")}).encode()


QUICK = {"multiarm-single", "dfki-A0", "emps", "xl330", "tribometer"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in public_sets()],
)
def test_tables_are_those_of_the_documentation(name: str, data_dir: Path, tmp_path: Path) -> None:
    chosen = public_sets()[name]
    cards = data_dir / FOLDERS[chosen.source]
    listed = pd.read_csv(cards / "recordings.csv").set_index("id")
    tables = {r: pd.read_csv(cards / listed["file"][r]) for r in chosen.recordings}
    if chosen.source == "multiarm":
        joints = int(listed.filter(like="q0_").loc[next(iter(tables))].count())
        whole = np.zeros((2 * joints, 90000))
        for recording, table in tables.items():
            first = round(1e3 * listed["source_t0"][recording])
            measured = table.drop(columns="time").to_numpy()
            whole[:, first : first + len(table)] = measured.T
            # The initial-state filter uses the 15 samples before, which are not given here.
            before = np.polynomial.polynomial.polyvander(np.arange(-15, 40) / 40, 4)
            whole[:, first - 15 : first] = (
                before[:15] @ np.linalg.lstsq(before[15:], measured[:40], rcond=None)[0]
            ).T
        q, qd = np.split(whole, 2)
        path = put(tmp_path, name, next(iter(tables)))
        scipy.io.savemat(path, swing_pieces(q + np.pi, qd, 26))
    elif name == "emps":
        table = tables["emps_first"]
        whole = {k: np.zeros((24000, 1)) for k in ("qm", "qg", "vir")}
        for key, column in (("qm", "q1"), ("qg", "q_ref1"), ("vir", "u1")):
            whole[key][10:12420, 0] = table[column]
        scipy.io.savemat(put(tmp_path, name, "emps_first"), whole | {"gtau": 35.150652})
    else:
        for recording, table in tables.items():
            put(tmp_path, name, recording).write_bytes(original_of(chosen.source, table))
    fetched = fetch(name, tmp_path)
    if name == "emps":  # rounded voltages change the last digit of forces
        written = pd.read_csv(tmp_path / "emps_first.csv.gz")
        np.testing.assert_allclose(written, tables["emps_first"], atol=3e-5)
    elif name == "xl330":  # one log contains the lift and the drop; only the drop is documented
        assert set(fetched.differing) == {"lift_and_drop_kp100", "lift_and_drop_kp400"}
    else:
        assert fetched.differing == ()
    if chosen.source in {"multiarm", "dfki"}:
        states = read_initial_states(tmp_path / "recordings.csv")
        for recording, (q0, qd0) in read_initial_states(cards / "recordings.csv").items():
            if recording in states:
                np.testing.assert_allclose(states[recording][0], q0, atol=2e-4)
                np.testing.assert_allclose(states[recording][1], qd0, atol=5e-2)
