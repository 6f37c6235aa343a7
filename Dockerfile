# The CPU renderer and everything else in one image:
#   docker build -t gnmreg .
#   docker run --rm -u "$(id -u)" -v "$PWD:/data" gnmreg register CAPTURE --model MODEL --out OUT
# The base has what a fresh Debian 13 has; the packages below are what `make setup` would ask for.
FROM debian:13-slim

RUN apt-get update \
 && apt-get install -y --no-install-recommends ca-certificates make python3 python3-venv \
      libllvm19 libatomic1 \
 && rm -rf /var/lib/apt/lists/*

# Any user may run the image: caches (compiled kernels, model weights) go to a home that all can write.
ENV HOME=/home/gnmreg PIP_NO_CACHE_DIR=1
WORKDIR /opt/gnm-registration
COPY . .
RUN mkdir -p "$HOME" && make setup && chmod -R a+rwX "$HOME"

WORKDIR /data
ENTRYPOINT ["/opt/gnm-registration/.venv/bin/gnmreg"]
