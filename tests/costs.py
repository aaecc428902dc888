"""CPU seconds of each test, into the file that JAXKANE_TEST_COSTS names: seconds, a tabulator, the test.

A program is charged to the test that needs it first. `.ci/summary` adds the seconds by folder.
"""

import os
from pathlib import Path

import pytest

FILE = "JAXKANE_TEST_COSTS"


def watch(config):
    if FILE in os.environ:
        config.pluginmanager.register(Costs(config))


def cpu_seconds() -> float:
    """Of all threads of this process, and of the processes that it has started and awaited."""
    return sum(os.times()[:4])


class Costs:
    def __init__(self, config):
        self.is_first = not hasattr(config, "workerinput")  # False in the processes of pytest-xdist
        self.started, self.costs = 0.0, {}

    def pytest_runtest_logstart(self):
        self.started = cpu_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, call):
        report = yield
        if call.when == "teardown":
            report.user_properties.append(("cpu_s", cpu_seconds() - self.started))
        return report

    def pytest_runtest_logreport(self, report):
        if report.when == "teardown":
            self.costs[report.nodeid] = dict(report.user_properties)["cpu_s"]

    def pytest_sessionfinish(self):
        if self.is_first:
            lines = [f"{seconds:.2f}\t{test}\n" for test, seconds in self.costs.items()]
            Path(os.environ[FILE]).write_text("".join(lines), encoding="utf-8")
