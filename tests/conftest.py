"""Settings for all tests."""

import asyncio
import os

import filters
import pytest
from daemon import Ground
from hypothesis import settings

from risaf_link.core import kernel
from risaf_link.mavlink import frame, search

settings.register_profile(
    "risaf",
    deadline=None,  # a busy machine is no failure
    derandomize="CI" in os.environ,  # nor is a change that did not touch what fails
)
settings.load_profile("risaf")


@pytest.fixture(scope="module", params=filters.FORMS)
def filter_form(request):
    """Run the tests of a module on both forms of fusion and filter."""
    if request.param == "kernel" and not kernel.BUILT:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    with pytest.MonkeyPatch.context() as patch:
        for numpy_form, form in zip(
            filters.FORMS["numpy"], filters.FORMS[request.param], strict=True
        ):
            for module in (filters, request.module):
                if hasattr(module, numpy_form.__name__):
                    patch.setattr(module, numpy_form.__name__, form)
        yield request.param


@pytest.fixture(params=["python", "kernel"], scope="module")
def cutter(request):
    """Frames are cut by either form."""
    if request.param == "kernel" and frame.cut is search.cut:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "python":
            patch.setattr(frame, "cut", search.cut)
        yield


@pytest.fixture
async def ground():
    """A UDP socket that feeds a service and listens to it."""
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(Ground, local_addr=("127.0.0.1", 0))
    yield protocol
    transport.close()
