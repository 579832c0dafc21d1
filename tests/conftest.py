"""Settings for all tests."""

import os

import pytest
from hypothesis import settings

from risaf_link.mavlink import frame, search

settings.register_profile(
    "risaf",
    deadline=None,  # a busy machine is no failure
    derandomize="CI" in os.environ,  # nor is a change that did not touch what fails
)
settings.load_profile("risaf")


@pytest.fixture(params=["python", "kernel"], scope="module")
def cutter(request):
    """Frames are cut by either form."""
    if request.param == "kernel" and frame.cut is search.cut:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "python":
            patch.setattr(frame, "cut", search.cut)
        yield
