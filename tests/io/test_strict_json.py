"""JSON from untrusted files: finite numbers only."""

import pytest

from nfriction.io.files import numbers, parse_json


def test_valid_json_is_read() -> None:
    assert parse_json(b'{"a": [1, 2.5, null, "NaN"]}') == {"a": [1, 2.5, None, "NaN"]}
    assert parse_json('{"a": 1, "a": 2}', lambda pairs: {"n": len(pairs)}) == {"n": 2}


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1" * 400])
def test_numbers_are_finite(number: str) -> None:
    with pytest.raises(ValueError, match=f"numbers must be finite, .*{number[:40]}"):
        parse_json(f'{{"a": [{number}]}}')


@pytest.mark.parametrize("text", ["", "{", "[1,]", '{"a" 1}'])
def test_invalid_json_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="line 1"):
        parse_json(text)


def test_booleans_are_not_numbers() -> None:
    assert numbers("x", [1, [2.5, "nan"]], words=("nan",))[1][0] == 2.5
    for bad in (True, [1, [False]], None, "1", {"a": 1}, 10**400):
        with pytest.raises(ValueError, match="`x`"):
            numbers("x", bad)
