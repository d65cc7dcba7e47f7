"""The example packages lie beside the product, as somebody else's would; tests import them from their folders."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path[:0] = [str(ROOT / "examples" / name) for name in ("manufacturing", "flow_records")]
