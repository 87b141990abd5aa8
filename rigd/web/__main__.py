"""Program of the page's process; the daemon starts it and gives it its job."""

from rigd.web import run_page

if __name__ == "__main__":
    run_page()
