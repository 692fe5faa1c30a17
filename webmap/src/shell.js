// The window around the map. The map is a frame of another origin: where that may be led to is for this window's policy
// to say, and it can neither lead this window elsewhere nor open another. Of it come the permalink and a title, no more.
import './shell.css';

const origin = `${location.protocol}//127.0.0.1:${location.port}`;
const address = () => `${origin}/map/index.html${location.hash}`;
const frame = document.createElement('iframe');
Object.assign(frame, { title: 'map', sandbox: 'allow-scripts allow-same-origin allow-downloads', src: address() });
document.body.append(frame);

addEventListener('hashchange', () => frame.contentWindow.location.replace(address()));
addEventListener('message', (said) => {
  if (said.source !== frame.contentWindow || said.origin !== origin) return;
  history.replaceState(null, '', `#${String(said.data.hash).slice(1)}`);
  document.title = String(said.data.title);
});
