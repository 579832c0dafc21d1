"""Settings for all tests."""

import os

from hypothesis import settings

settings.register_profile(
    "risaf",
    deadline=None,  # a busy machine is no failure
    derandomize="CI" in os.environ,  # nor is a change that did not touch what fails
)
settings.load_profile("risaf")
