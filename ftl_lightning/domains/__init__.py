"""Domains: behaviour, concepts, sources of demonstrations and metrics of plans.

``domain`` defines domains, ``tasks`` evaluation tasks; ``registry`` finds domains by name, here and in other packages.
``generated`` makes a source from a function, ``line_plots`` draws any behaviour; ``from_file`` needs no code.
The smallest domain is the package ``examples/ftl-strokes``. The folders here are the paper's domains.
"""
