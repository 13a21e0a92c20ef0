"""Sliders for a fabric, in a browser: `subject` is what is simulated, `page` what is seen.

Needs viser: pip install 'r2s[viz]'; `subject` does not.
"""
