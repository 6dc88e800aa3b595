"""The report: one self-contained HTML page that says what was done and how sure it is."""

from dougong.report.render import build, rebuild

__all__ = ["build", "rebuild"]
