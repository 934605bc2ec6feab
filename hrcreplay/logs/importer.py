"""Our log from the text files that skeleton recordings come in, one module a format."""

from __future__ import annotations

from hrcreplay.logs.import_azure import import_azure
from hrcreplay.logs.import_keraal import import_keraal
from hrcreplay.logs.import_kinect2 import import_kinect2

__all__ = ["import_azure", "import_keraal", "import_kinect2"]
