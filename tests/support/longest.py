"""The test files that take longest, in the order in which they are begun."""

LONGEST = (
    "plugins/hyaline_web/tests/page/test_page.py",
    "tests/proxies/test_proxies.py",
    "plugins/hyaline_photos/tests/fit/test_fit.py",
    "tests/datagen/scene/test_scenes.py",
    "tests/datagen/builder/test_shards.py",
    "tests/datagen/render/test_thin_walls.py",
    "tests/datagen/render/test_render.py",
    "tests/model/run/test_interrupted.py",
    "plugins/hyaline_import/tests/test_confined_import.py",
    "plugins/hyaline_photos/tests/fit/test_kinds.py",
    "plugins/tests/reliability/test_hostile_files.py",
    "tests/eval/page/test_page_in_browser.py",
    "plugins/hyaline_photos/tests/fit/test_boxes.py",
)
