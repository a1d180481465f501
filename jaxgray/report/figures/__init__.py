"""Figures for papers, by matplotlib: of an `identification`, its modes (`modal`), and a `diagnosis`."""
