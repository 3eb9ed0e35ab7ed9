# docker build -t asm-gym . && docker run --rm asm-gym          the demonstration
# docker run --rm asm-gym make test                             the tests
FROM python:3.13-slim-bookworm

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# EGL and Mesa draw without a screen.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
       git libegl1 libgl1 libgl1-mesa-dri make \
    && rm -rf /var/lib/apt/lists/*

ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
RUN useradd --create-home robot
WORKDIR /home/robot/asm-gym
COPY --chown=robot . .
RUN chown robot .
USER robot
RUN make .venv/.installed
CMD ["make", "demo"]
