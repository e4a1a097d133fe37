"""Training of an avatar: data streaming, schedule, optimiser groups, checkpoints and the loop (paper, section 4.1;
supplement A).
"""
