"""Providers of what no view shows: appearance and relative depth."""
