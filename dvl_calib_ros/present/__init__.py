"""Presentation of results: documents of sentences, tables and figures for a terminal, a page, JSON or a notebook.

Pages need matplotlib and jinja2, which are imported only for a page.
"""
