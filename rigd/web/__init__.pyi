from ._server import run_page as run_page
