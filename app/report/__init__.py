"""The report that a calibration leaves: one HTML file that needs nothing else, for an operator and for a researcher."""

from __future__ import annotations

from app.report.model import LevelReport, RunReport
from app.report.page import render_report, write_report
from app.report.picture_set import picture_set_report

__all__ = ["LevelReport", "RunReport", "picture_set_report", "render_report", "write_report"]
