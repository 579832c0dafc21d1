"""Makes `python -m risaf_link.cli` the same as `risaf-link`."""

from risaf_link.cli import main

main(prog_name="risaf-link")
