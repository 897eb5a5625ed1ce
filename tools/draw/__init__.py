"""Everything that the tools draw: figures (matplotlib), pictures with marks, and HTML pages that need nothing else."""
