"""The whole system at work for as long as one likes: `python -m tests.soak`."""
