"""One HTML page about one fit, complete in itself: pictures, curves, numbers, and how to make it again."""

from jvr.report.page.document import write_fit_page as write_fit_page
