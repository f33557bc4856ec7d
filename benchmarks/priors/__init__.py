"""Candidates for a prior of cloth that moves right on motions nobody trained on, measured on true cloth."""
