"""The folder of the reference files, if they are present."""

import os
from pathlib import Path

REFERENCE = Path(
    os.environ.get("JAXLAG_REFERENCE", Path(__file__).parents[3] / "shared" / "reference")
)
