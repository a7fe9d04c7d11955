"""How results are shown: each is a document of sentences, tables and figures, for a terminal, a page, JSON, a notebook.

Pages need matplotlib and jinja2, which are imported when one is asked for.
"""
