"""Reports that people read: one self-contained HTML file from a replay, an evaluation, a diagnosis or a comparison.

Needs matplotlib and jinja2; nothing else in the package imports this, the commands do so when a report is asked for.
"""

from .comparison_report import write_comparison_report
from .cross_check_report import write_cross_check_report
from .diagnosis_report import write_diagnosis_report
from .evaluation_report import write_evaluation_report
from .replay_report import write_replay_report
from .unpaired_report import write_unpaired_report

__all__ = [
    "write_comparison_report",
    "write_cross_check_report",
    "write_diagnosis_report",
    "write_evaluation_report",
    "write_replay_report",
    "write_unpaired_report",
]
