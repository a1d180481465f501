"""The manual: pages that a browser shows from a folder, without a network.

site             the manual as a folder of pages
configuration    menu, theme and plug-ins for MkDocs
reference        the page of the public names
effect_pages     a page for each effect
effect_curves    curves for these, computed by the law itself
effect_pictures  their pictures, as SVG
look_alikes      the experiment that tells an effect from its look-alikes
gallery          what the examples found
"""

from .site import build

__all__ = ["build"]
