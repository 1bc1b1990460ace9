"""What a run leaves: the model, pictures, curves, a page and a report."""

from advtex_engine.results.compressed import require_draco, write_compressed
from advtex_engine.results.export import export_model
from advtex_engine.results.gallery import write_gallery
from advtex_engine.results.levels import write_smaller
from advtex_engine.results.report import assembled, describe_scene, heldout_scores, write_report
from advtex_engine.results.result_page import write_page
from advtex_engine.results.seen import write_seen
from advtex_engine.results.tiles import write_tiles

__all__ = [
    "assembled",
    "describe_scene",
    "export_model",
    "heldout_scores",
    "require_draco",
    "write_compressed",
    "write_gallery",
    "write_page",
    "write_report",
    "write_seen",
    "write_smaller",
    "write_tiles",
]
