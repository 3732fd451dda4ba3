"""The files that exported C is made of travel with the package."""

from importlib import resources

import pytest


@pytest.mark.parametrize("name", ["arduino.ino", "selftest.c", "simulink.c", "wrapper.hpp"])
def test_a_template_is_found_where_the_package_is(name):
    template = resources.files("nfriction.export").joinpath("c_templates", name)
    text = template.read_text("ascii")
    assert "$HEADER" in text  # the one word that all of them are filled with
