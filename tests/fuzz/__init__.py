"""Broken and hostile input: whatever comes, it is refused or taken, and nothing else happens."""
