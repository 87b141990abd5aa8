"""Program of the process that serves the operator's page, which the daemon starts."""

from rigd.web import run_page

if __name__ == "__main__":
    run_page()
