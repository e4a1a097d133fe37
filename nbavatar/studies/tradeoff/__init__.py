"""Speed against quality of a trained avatar: settings, their measurement, fronts, presets, and what each saving is
worth.
"""
