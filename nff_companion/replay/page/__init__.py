"""One flight as a page that stands alone: no network, no script."""
