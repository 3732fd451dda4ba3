"""The files that exported C is made of travel with the package."""

from importlib import resources

import pytest

NAMES = ["adaptive.c", "arduino.ino", "controller.c", "controller.h", "exponential.c", "filter.c",
         "neurofuzzy.c", "numbers.c", "selftest.c", "simulink.c", "wrapper.hpp"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_template_is_found_where_the_package_is(name):
    template = resources.files("nfriction.export").joinpath("templates", name)
    text = template.read_text("ascii")
    assert "nf_" in text or "NF_" in text  # in place of which the prefix is written
