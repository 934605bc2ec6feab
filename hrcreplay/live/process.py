"""How each process beside control runs: ``python -m hrcreplay.live.process FOLDER PART MODULE arguments``.

Whatever ends it that nobody foresaw is kept with its traceback in the run folder, not on the user's terminal; control
sees the process gone, brakes the robot and tells of it.
"""

from __future__ import annotations

import os
import runpy
import sys
import threading
from pathlib import Path
from typing import NoReturn

from hrcreplay.live import crash

#: Exit code of a process that crashed, as sysexits.h has it for internal errors.
CRASHED = 70


def main() -> None:
    """Runs a module as ``python -m`` does."""
    folder, part, module, *arguments = sys.argv[1:]

    def die(error: BaseException) -> NoReturn:
        crash.write(Path(folder), part, error)
        os._exit(CRASHED)  # other threads may wait for one that is gone

    threading.excepthook = lambda raised: die(raised.exc_value or SystemError("a thread ended without a reason"))
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except Exception as error:  # whatever it is
        die(error)


if __name__ == "__main__":
    main()
