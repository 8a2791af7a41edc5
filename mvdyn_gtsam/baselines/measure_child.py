"""Start one command and write what it took: ``python -I -S measure_child.py USAGE_JSON COMMAND...``.

A program of its own, with nothing imported: Linux lets a child inherit the peak memory of the process that
starts it (``exec_mmap`` keeps ``signal->maxrss``), so the starter has to be small.
"""

import json
import os
import sys
import time


def main(arguments: list[str]) -> int:
    usage_path, command = arguments[0], arguments[1:]
    start = time.monotonic()
    child = os.posix_spawn(command[0], command, os.environ)
    _, status, usage = os.wait4(child, 0)
    seconds = time.monotonic() - start
    code = os.waitstatus_to_exitcode(status)
    content = {
        "seconds": seconds,
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
        # Kilobytes on Linux, bytes on macOS.
        "peak_mb": usage.ru_maxrss / (1024.0 if sys.platform != "darwin" else 1024.0**2),
        "exit_code": code,
    }
    with open(usage_path, "w") as file:
        json.dump(content, file)
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
