"""What a run is made of: units of work, the files they come from, and the options they get.

The Snakefile asks this package whom a rule works on and what its job is told; the rules themselves say where results
are, and depend on each other. Standard library only, because every job of the workflow imports it.
"""
