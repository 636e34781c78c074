"""Guaranteed ranges of expressions over boxes: interval programs and their evaluation."""
