"""Propose a detector's values for a site, and fit its score and its sigma."""
