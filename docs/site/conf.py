"""Sphinx's settings for the site; docs/site/make.py gathers its pages."""

project = "Buddyline"
extensions = ["myst_parser"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "Buddyline"
html_show_sphinx = False
