"""The machine that results are measured on."""

from __future__ import annotations

import platform
from contextlib import suppress
from typing import Any

from mtsp_env.machine import usable_cores


def describe_machine() -> dict[str, Any]:
    """Processor, number of cores that this process may use, platform and Python version."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError), open("/proc/cpuinfo") as file:
        lines = (line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
        processor = next(lines, processor)
    return {
        "processor": processor,
        "cores": len(usable_cores()),
        "platform": platform.platform(),
        "python": platform.python_version(),
    }
