// Who signs in. The one place that knows how the service is shown who asks: today by a token in a cookie
// (so that pictures and downloads work) and in a header (which alone may change something).

const NAME = "sci_recon_token";

const kept = () => document.cookie.split("; ").find((pair) => pair.startsWith(`${NAME}=`))?.slice(NAME.length + 1);

function write(value, more) {
  const secure = location.protocol === "https:" ? "; Secure" : "";
  document.cookie = `${NAME}=${value}; path=${new URL(".", document.baseURI).pathname}; SameSite=Strict${secure}${more}`;
}

/** The header that goes with a request, of the token that is kept or of another one. */
export function authorization(token = kept()) {
  return token ? { Authorization: `Bearer ${token}` } : {};
}

/** Keeps a token for as long as the browser runs. */
export function keep(token) {
  write(encodeURIComponent(token), "");
}

/** Signs out. */
export function forget() {
  write("", "; Max-Age=0");
}
