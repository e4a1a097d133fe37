"""Synthetic subjects: licence-free body models, a person with a hand at the face, and a dataset in Decaf's layout."""
