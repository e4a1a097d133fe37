"""Masks and crops: from delivered pictures to the square windows that training reads."""
