"""Diagnosis: where a recording departs from the source, which effects cause it, and how far they close the gap."""

from visadapt.diagnosis.diagnose import diagnose
from visadapt.diagnosis.result import Diagnosis

__all__ = ["Diagnosis", "diagnose"]
