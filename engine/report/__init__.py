"""Reports as PDF: one trial on one page, or several trials in one summary."""

from __future__ import annotations

from engine.report.job_report import render_job_report
from engine.report.options import ReportOptions
from engine.report.trial_report import render_trial_report

__all__ = ["ReportOptions", "render_job_report", "render_trial_report"]
