from .benchmark.options import BenchOptions as BenchOptions
from .benchmark.protocol import Extractor as Extractor
from .benchmark.run import bench_extractors as bench_extractors
from .quickstart import compare_folder as compare_folder
from .quickstart import run_quickstart as run_quickstart
from .rigs.compare import compare_rigs as compare_rigs
from .study.results import Finding as Finding
from .study.run import run_study as run_study
from .study.study import Study as Study

__all__: list[str]
