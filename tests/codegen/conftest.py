"""Send compiled code to a cache of this test run, shared so that it is built only once."""

import pytest


@pytest.fixture(autouse=True)
def _cache(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.getbasetemp() / "compiled"
    folder.mkdir(mode=0o700, exist_ok=True)
    monkeypatch.setenv("NFRICTION_CACHE", str(folder))
