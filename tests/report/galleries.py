"""Galleries of views for tests."""

from splatax.report.gallery import Gallery


def gallery_of(comparisons, **limits):
    """A gallery that has seen these views."""
    gallery = Gallery(**limits)
    for comparison in comparisons:
        gallery.see(comparison)
    return gallery
