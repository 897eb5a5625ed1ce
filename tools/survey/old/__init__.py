"""Surveys made with other programs: their files are read into one model, adjusted with ours, and written again."""
