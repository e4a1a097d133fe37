"""Small scenes that tests of several areas share."""
