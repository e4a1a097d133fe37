"""Tables, figures and the HTML report: results beside the numbers that the paper prints."""

__all__: list[str] = []
