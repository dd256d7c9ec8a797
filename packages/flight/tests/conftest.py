"""Tests of DDS are collected where cyclonedds is installed; it has no wheel for Python 3.14."""

import importlib.util

NEEDS_DDS = "test_ros2_dds.py"
collect_ignore = [] if importlib.util.find_spec("cyclonedds") else [NEEDS_DDS]


def pytest_terminal_summary(terminalreporter):
    for name in collect_ignore:
        terminalreporter.write_line(f"{name} is left out: cyclonedds is not installed here.")
