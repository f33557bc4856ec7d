"""The study: the paper's tables and the baselines, trained and measured on one capture."""

from dsar.evaluation.study.runner import Study
from dsar.evaluation.study.summary import summarize_tables, to_markdown
from dsar.evaluation.study.tables import ABLATIONS, BASELINES, Row, Table

__all__ = ["ABLATIONS", "BASELINES", "Row", "Study", "Table", "summarize_tables", "to_markdown"]
