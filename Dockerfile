# Trains and evaluates in a container (`make run`), and copies the run out of it:
#   docker build --tag jaxnav . && docker run --name jaxnav jaxnav && docker cp jaxnav:/jaxnav/runs .
FROM python:3.11-slim

RUN apt-get update && apt-get install --yes --no-install-recommends make && rm -rf /var/lib/apt/lists/* \
 && useradd --create-home jaxnav && install --directory --owner jaxnav /jaxnav

USER jaxnav
WORKDIR /jaxnav
COPY --chown=jaxnav . .
RUN make setup

CMD ["make", "run"]
