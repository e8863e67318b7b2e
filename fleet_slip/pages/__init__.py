"""Shared parts of HTML pages: styles, drawings, tables and templates."""
