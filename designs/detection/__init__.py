"""Alarms from guaranteed fault bounds."""
