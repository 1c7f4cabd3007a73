// The token, where the service wants one. It is kept in a cookie for as long as the browser runs, so
// that links for downloads work; what changes something also needs it as a header.

const NAME = "sci_recon_token";
let refused = false;

const token = () => document.cookie.split("; ").find((pair) => pair.startsWith(`${NAME}=`))?.slice(NAME.length + 1);

/** The header that goes with every request. */
export function authorization() {
  const text = token();
  return text ? { Authorization: `Bearer ${text}` } : {};
}

/** Asks for a token, after one (or none) was refused; true if there is another one to try. */
export function signIn(tried) {
  if (authorization().Authorization !== tried) return true;
  if (refused) return false;
  const text = window.prompt("This service wants a token (sci-recon token create):")?.trim();
  refused = !text;
  if (refused) return false;
  const secure = location.protocol === "https:" ? "; Secure" : "";
  document.cookie = `${NAME}=${encodeURIComponent(text)}; path=${new URL(".", document.baseURI).pathname}; SameSite=Strict${secure}`;
  return true;
}
