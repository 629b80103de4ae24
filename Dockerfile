# docker build -t bevviz . && docker run --rm -v "$PWD/bags:/bags" bevviz batch /bags -o /bags/runs
FROM python:3.12-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends git && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
RUN python -m venv /opt/bevviz \
    && /opt/bevviz/bin/pip install --no-cache-dir --constraint docs/constraints.txt ".[workbench,evaluate,dask,velodyne,draco]"

FROM python:3.12-slim-bookworm
COPY --from=build /opt/bevviz /opt/bevviz
ENV PATH=/opt/bevviz/bin:$PATH NUMBA_CACHE_DIR=/tmp/numba BEVVIZ_STORE=/tmp/bevviz
RUN useradd --create-home bevviz
USER bevviz
WORKDIR /bags
ENTRYPOINT ["bevviz"]
CMD ["--help"]
