"""The templates of exported C are part of the package."""

from importlib import resources

import pytest

NAMES = ["adaptive.c", "arduino.ino", "controller.c", "controller.h", "exponential.c", "filter.c",
         "neurofuzzy.c", "numbers.c", "selftest.c", "simulink.c", "wrapper.hpp"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_template_is_found_in_the_package(name):
    template = resources.files("nfriction.export").joinpath("templates", name)
    text = template.read_text("ascii")
    assert "nf_" in text or "NF_" in text  # placeholder of the prefix
