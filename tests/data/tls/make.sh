#!/bin/sh
# Makes the certificates beside it, for tests only; valid for 100 years. Nothing that matters may ever trust them.
set -eu
cd "$(dirname "$0")"
key() { openssl ecparam -name prime256v1 -genkey -noout -out "$1.key"; }
authority() {
    key "$1"
    openssl req -x509 -new -key "$1.key" -subj "/CN=pebble test $1" -days 36500 -out "$1.crt"
}
authority ca
authority other-ca
for name in server client; do
    key $name
    openssl req -new -key $name.key -subj "/CN=$name" -out $name.csr
    printf 'subjectAltName=DNS:localhost\n' > $name.ext
    openssl x509 -req -in $name.csr -CA ca.crt -CAkey ca.key -CAcreateserial -days 36500 -extfile $name.ext -out $name.crt
    rm $name.csr $name.ext
done
rm -f ca.key ca.srl other-ca.key
