"""Closed forms, forces, scans and calibration."""
