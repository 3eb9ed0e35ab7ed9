# docker build -t asm-gym . && docker run --rm asm-gym          the demonstration
# docker run --rm asm-gym make test                             the tests
FROM python:3.11-slim-bookworm

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# evdev, which robosuite needs, is compiled; opencv links to GL and GLib; EGL and Mesa draw without a screen.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
       gcc git libc6-dev libegl1 libgl1 libgl1-mesa-dri libglib2.0-0 linux-libc-dev make \
    && rm -rf /var/lib/apt/lists/*

ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
RUN useradd --create-home robot
WORKDIR /home/robot/asm-gym
COPY --chown=robot . .
RUN chown robot .
USER robot
RUN make .venv/.installed
CMD ["make", "demo"]
