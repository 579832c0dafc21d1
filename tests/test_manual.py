"""Units, ranges and texts of parameters stand in one place; manual and example repeat them."""

import manual

from risaf_link.mavlink.commands import Command


def test_the_page_has_every_parameter_as_it_is():
    assert manual.PAGE.read_text() == manual.page()


def test_the_page_on_mqtt_has_every_field_as_it_is():
    assert manual.TOPICS_PAGE.read_text() == manual.topics_page()


def test_the_example_says_of_every_parameter_what_the_page_says():
    assert manual.EXAMPLE.read_text() == manual.example()


def test_every_parameter_says_what_it_does_and_in_which_unit():
    for parameter, text in manual.documented():
        assert len(text) > 10
        assert parameter.unit or parameter.words or 0 <= parameter.lowest < parameter.highest <= 1


def test_the_page_has_every_command():
    page = manual.PAGE.read_text()
    for command in Command:
        assert f"| {command.name} ({command.value}) |" in page
