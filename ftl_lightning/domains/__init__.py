"""Domains: what behaviour is, which concepts it shows, where demonstrations come from and how plans are judged.

``domain`` says what a domain is, ``tasks`` what is evaluated, ``registry`` finds domains by name, here and in other packages.
``generated`` makes a source of a function, ``line_plots`` are pictures for any behaviour; ``from_file`` needs no code at all.
The smallest domain is ``examples/ftl-strokes``, a package of its own. The folders here are the paper's domains.
"""
