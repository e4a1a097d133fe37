"""FLAME and MANO from their official files, differentiable, without chumpy."""
