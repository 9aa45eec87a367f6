"""Pictures of a page as a headless browser shows it, for the documentation."""

from pathlib import Path

from benchmarks.pages.browser import open_file, running_browser, watched_page


def take_screenshot(page: Path, *, width: int, height: int, dark: bool, rays: int, link: str) -> bytes:
    """The PNG of a page whose window is so wide and high, when all its pixels have so many rays.

    Args:
        rays: 0 for a page that draws none, such as a report.
        link: what stands after the # of the page's address.
    """
    with running_browser() as browser, watched_page(browser, width=width, height=height, dark=dark) as watched:
        if not rays:
            watched.page.goto(page.resolve().as_uri() + (f"#{link}" if link else ""))
            return watched.page.screenshot()
        open_file(watched, page, link=link)
        # Drawn by the processor, a frame takes seconds for every 100,000 pixels.
        watched.evaluate("async (rays) => (await hyaline).frames.still(rays)", rays, patience_ms=1_800_000)
        return watched.page.screenshot()
