"""What a diver would forget, checked: pure judgements, and a shell that gathers what they judge."""
