"""The script that makes a page's pictures interactive: plotly.js, packed into the page.

It comes from the Python package ``plotly``, of which nothing is imported.  Packed (gzip, base64)
it takes 2 MB instead of 5; a browser unpacks it in a few hundredths of a second.  Where the
package is missing, pages hold the pictures alone.
"""

import base64
import gzip
import importlib.util
from functools import lru_cache
from pathlib import Path


@lru_cache(maxsize=1)
def packed_library() -> str:
    """Return plotly.js as base64 of its gzip; empty where the package is not installed."""
    found = importlib.util.find_spec("plotly")
    for folder in found.submodule_search_locations or () if found else ():
        script = Path(folder, "package_data", "plotly.min.js")
        if script.is_file():
            # Without a time of its own, so that the same answer gives the same page.
            return base64.b64encode(gzip.compress(script.read_bytes(), 6, mtime=0)).decode("ascii")
    return ""
