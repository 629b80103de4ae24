# docker build -t bevviz . && docker run --rm -v "$PWD/bags:/bags" bevviz batch /bags -o /bags/runs
FROM python:3.12-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends git && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
RUN python -m venv /opt/bevviz \
    && /opt/bevviz/bin/pip install --no-cache-dir --constraint docs/constraints.txt ".[workbench,evaluate,dask,lidars]"

FROM python:3.12-slim-bookworm
# PyAV's wheel brings x264 and x265 (GPL): THIRD_PARTY_NOTICES.md says what follows for whoever passes the image on.
LABEL org.opencontainers.image.licenses="Apache-2.0 AND GPL-3.0-or-later"
COPY --from=build /opt/bevviz /opt/bevviz
COPY LICENSE THIRD_PARTY_NOTICES.md /usr/share/doc/bevviz/
ENV PATH=/opt/bevviz/bin:$PATH NUMBA_CACHE_DIR=/tmp/numba BEVVIZ_STORE=/tmp/bevviz
RUN useradd --create-home bevviz
USER bevviz
WORKDIR /bags
ENTRYPOINT ["bevviz"]
CMD ["--help"]
