"""Generate the Python module of the dialect from ``nff.xml`` and the ``common.xml`` that pymavlink ships.

Run by the build (``hatch_build.py``), or by hand: ``python mavlink_dialect/generate.py``.
"""

from __future__ import annotations

import contextlib
import os
import py_compile
import shutil
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
TARGET = HERE.parent / "nff_companion" / "mavlink" / "dialect" / "nff.py"
_INCLUDED = ("common.xml", "standard.xml", "minimal.xml")


def generate(target: Path = TARGET) -> Path:
    """Write the module to ``target``. Raises RuntimeError when the generator refuses the XML."""
    import pymavlink
    from pymavlink.generator import mavgen

    shipped = Path(pymavlink.__file__).parent / "dialects" / "v20"
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(HERE / "nff.xml", folder)
        for name in _INCLUDED:
            shutil.copy(shipped / name, folder)
        options = mavgen.Opts(
            output=os.path.join(folder, "nff.py"), wire_protocol="2.0", language="Python3", validate=True
        )
        with contextlib.redirect_stdout(sys.stderr):
            ok = mavgen.mavgen(options, [os.path.join(folder, "nff.xml")])
        if not ok:
            raise RuntimeError("mavgen refused mavlink_dialect/nff.xml: see its messages above")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(os.path.join(folder, "nff.py"), target)
    # Without its byte code the daemon would compile two megabytes of source at each start, in 60 MB of memory.
    py_compile.compile(str(target), doraise=True)
    return target


if __name__ == "__main__":
    print(generate())
