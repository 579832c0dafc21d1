"""The kernel's extension module, `native`; None where it was not built."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from risaf_link.core import _kernel as native
else:
    try:
        from risaf_link.core import _kernel as native
    except ImportError:
        native = None

__all__ = ["native"]
